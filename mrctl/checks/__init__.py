"""Is the physics right, and if not, why? The checks, the examination of a robot by them, and the pytest plugin.

`tests/physics`, `mrctl check` and `pytest --mrctl-robot` all run the same checks. README.md explains them.
Imports `mrctl.record`, theory and physics.
"""
