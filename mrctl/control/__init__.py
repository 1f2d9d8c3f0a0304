"""The laws, one a file: motion controller, limiter, PID, feedforwards, guard, steering.

Each law is one function for one robot on named records, compiled by `mrctl.kernel`. Laws know the theory and nothing of
physics, sensors or scenarios; `mrctl.loop.hierarchy` wires them.
"""
