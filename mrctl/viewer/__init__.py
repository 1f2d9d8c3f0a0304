"""The viewer in the browser: live sessions, replays, and files that play without a server.

It drives the simulation of `mrctl.loop` and has no physics of its own. Imports the rooms up to
`mrctl.navigation`, and the sweep.
"""
