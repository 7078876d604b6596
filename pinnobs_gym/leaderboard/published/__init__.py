"""Published results: rows and trained files that ship with the package.

They are made by ``make publish`` and read-only. ``published.json`` lists every file with its size
and its hash; nothing is read that it does not list.
"""
