"""The measurements that the controller receives: posture, twist, and the slip of the driven wheels.

Imports `mrctl.kernel` and `mrctl.theory`.
"""
