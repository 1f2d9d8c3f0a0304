"""The robot on paper: its parameters, equations (1) to (3), references and their time laws, and perturbations as data.

This folder holds formulas on arrays, without MuJoCo and without controllers. It imports `mrctl.record` and
`mrctl.kernel` alone.
"""
