"""Thousands of runs: the sweep file, the jobs it is cut into, the processes that compute them, and the store.

Imports the loop and the results.
"""
