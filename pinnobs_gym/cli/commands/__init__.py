"""The commands of `pinnobs`, one module each.

A module has the name of its command. The first line of its docstring is "`NAME ARGUMENTS`:
purpose", and ``run(arguments)`` returns the exit status.
"""
