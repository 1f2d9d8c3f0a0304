"""Is the physics right, and if not, why? The checks, their diagnosis, and the pytest plugin.

`tests/physics`, `mrctl check` and `pytest --mrctl-robot` all run the same checks. Imports theory and physics.
"""
