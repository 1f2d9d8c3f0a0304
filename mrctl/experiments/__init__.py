"""Experiments behind the commands: the paper, the suite, tuning, identification and the benchmark.

They import the loop, the results and the sweep, but not MuJoCo.
"""
