"""Figure 3, closed: the hierarchy of controllers, a user's own stages, and the simulation that everybody runs.

Imports everything below it: theory, control, sensing, physics, `mrctl.scenario` and results.
"""
