"""The robot on paper: parameters, equations (1) to (3), drive, references and their time laws, perturbations.

And what stands around it: obstacles as shapes and arrays, clearance, cells with their distance field, rays.
This folder holds formulas on arrays, without MuJoCo and without controllers. It imports `mrctl.record` and
`mrctl.kernel` alone.
"""
