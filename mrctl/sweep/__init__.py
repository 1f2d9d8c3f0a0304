"""Sweeps of thousands of runs: the sweep file, its jobs, the workers that compute them, and the store.

Imports the rooms up to `mrctl.loop`.
"""
