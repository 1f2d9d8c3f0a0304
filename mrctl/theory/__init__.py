"""The robot on paper: its parameters, equations (1) to (3), the references it follows, and what can be wrong with it.

Arrays and formulas alone; nothing here knows MuJoCo or a controller. Imports `mrctl.record` and nothing else of mrctl.
"""
