"""The closed loop as environments for reinforcement learning, for `dm_env` and for Gymnasium.

Imports the rooms up to `mrctl.navigation`.
"""
