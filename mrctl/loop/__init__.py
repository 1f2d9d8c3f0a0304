"""The closed loop of figure 3: the hierarchy of controllers, a user's own stages, and the simulation.

Imports theory, control, sensing, physics, `mrctl.scenario` and results.
"""
