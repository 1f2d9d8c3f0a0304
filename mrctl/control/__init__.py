"""The laws, one in each file: motion controller, limiter, PID, feedforwards, guard, steering.

Each law is one function for one robot on named records, compiled by `mrctl.kernel`. A law may import the theory, but
neither physics nor sensors nor scenarios; `mrctl.loop.hierarchy` wires the laws.
"""
