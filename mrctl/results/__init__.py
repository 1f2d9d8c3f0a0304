"""Results of runs: labelled datasets, metrics, comparisons, figures and exports.

They import theory, control (for names and features) and `mrctl.scenario`, but neither physics nor the loop.
"""
