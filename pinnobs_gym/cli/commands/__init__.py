"""The commands of `pinnobs`, one module each.

A module is named like its command, its docstring's first line is "`NAME ARGUMENTS`: what it does",
and its ``run(arguments)`` returns the exit status.
"""
