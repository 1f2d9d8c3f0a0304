"""The robot on paper: its parameters, equations (1) to (3), reference trajectories, and perturbations as data.

This folder holds formulas on arrays, without MuJoCo and without controllers. It imports `mrctl.record` alone.
"""
