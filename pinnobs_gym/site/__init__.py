"""The leaderboard's page: one file that needs no server and no network, made from stored rows.

`data` turns rows and curves into the numbers shown, `charts` says how they are drawn, `palette`
in which colours, and `page` puts them into the template.
"""
