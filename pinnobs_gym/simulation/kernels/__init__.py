"""Compiled code of filters and solvers, made from a system's own equations.

The equations are traced to SymPy and written as C (`plant_code`), the algorithms are readable C
templates with the sizes as constants, and the two are compiled to a library that the user's cache
folder keeps. The code in NumPy is the reference, and is used wherever a kernel cannot be.
"""
