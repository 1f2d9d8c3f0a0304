"""Whether the physics of a robot is right, and if not, why: the checks, the diagnosis of failures, the pytest plugin.

`tests/physics`, `mrctl check` and `pytest --mrctl-robot` all run the same checks. README.md explains them.
Imports `mrctl.record`, `mrctl.kernel`, theory and physics.
"""
