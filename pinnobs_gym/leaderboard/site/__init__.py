"""The leaderboard's page: one file that needs no server and no network, made from stored rows.

`data`, `across` and `method` turn rows and curves into what is shown, `over_time` and `comparisons`
say how it is drawn, `palette` in which colours, and `page` puts it into the template.
"""
