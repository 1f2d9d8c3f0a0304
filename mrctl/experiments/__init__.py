"""What the commands of mrctl measure: the paper, the suite, tuning, identification, training, the benchmark.

Imports the loop, the results and the sweep.
"""
