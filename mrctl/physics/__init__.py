"""The robot in MuJoCo, from its MJCF file to the plant that the control loop steps.

One robot runs through dm_control and many run on `mujoco.batch`; both give the same bits.
Imports `mrctl.kernel`, `mrctl.record` and `mrctl.theory`.
"""
