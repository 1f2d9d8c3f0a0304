"""What the controllers are told: samples of sensors, and the posture, twist and slip that an estimator makes of them.

Imports `mrctl.kernel` and `mrctl.theory`.
"""
