"""The robot on paper: parameters, equations (1) to (3), drive, references and their time laws, perturbations.

It also has what surrounds the robot: obstacles as shapes and arrays, clearance, grids with their distance field, rays.
This folder holds formulas on arrays, without MuJoCo and without controllers. Of mrctl it imports only `mrctl.record`
and `mrctl.kernel`.
"""
