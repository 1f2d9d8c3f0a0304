"""The viewer in the browser: live sessions, replays, and files that play by themselves.

It composes the simulation and owns no physics. Imports the loop, the results and the sweep.
"""
