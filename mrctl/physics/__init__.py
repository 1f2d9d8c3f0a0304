"""The robot in MuJoCo: MJCF files, compiled models, perturbations of them, and the plant that is stepped.

One robot runs through dm_control, many on `mujoco.batch`, with the same bits.
Imports `mrctl.kernel` and `mrctl.theory`.
"""
