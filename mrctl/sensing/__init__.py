"""What the controller is shown: the measured posture and twist, and whether a wheel slips.

Imports `mrctl.kernel` and `mrctl.theory`.
"""
