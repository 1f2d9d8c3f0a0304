"""Sensors, a lidar, and the estimators that compute posture, twist and slip from their samples; the sensing tiers.

Imports `mrctl.record`, `mrctl.kernel` and `mrctl.theory`.
"""
