"""Sweeps of thousands of runs: the sweep file, its jobs, the workers that compute them, and the store.

They import the loop and the results.
"""
