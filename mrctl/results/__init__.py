"""What a run recorded: labelled datasets, metrics, comparisons, figures and exports.

Imports theory, control (for names and features) and `mrctl.scenario`; it knows neither physics nor the loop.
"""
