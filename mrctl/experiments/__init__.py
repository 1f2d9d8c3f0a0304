"""Experiments behind the commands: the paper, the suite, tuning, identification and the benchmark.

Imports the rooms up to `mrctl.sweep`, but not MuJoCo itself.
"""
