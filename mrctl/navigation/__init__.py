"""Figure 1 of the paper: worlds with obstacles from files and generators, and what finds a way through them.

The geometry is in `mrctl.theory`, walls and hulls are in `mrctl.physics`. Imports everything up to `mrctl.loop`.
README.md shows a run.
"""
