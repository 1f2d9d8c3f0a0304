"""The closed loop as environments for reinforcement learning: `dm_env` and Gymnasium.

Imports the loop.
"""
