"""The leaderboard's page: one file without server or network, made from stored rows.

`model` computes the content of the page: `games` from runs and curves by `over_episodes` and
`over_samples`, `across` over systems and conditions, and `method` the provenance of scores. `page`
renders that model with the template, and `drawings` its charts. `over_time` and `comparisons`
define the charts, and `palette` their colours.
"""
