"""Figure 1 of the paper: worlds with obstacles, ways through them, missions, and the avoidance of obstacles.

The geometry is in `mrctl.theory`, walls and hulls are in `mrctl.physics`. Imports the rooms up to `mrctl.loop`.
README.md shows a mission.
"""
