"""The leaderboard's page: one file that needs no server and no network, made from stored rows.

`model` computes once all that is shown: `games` from runs and curves by means of `over_episodes`
and `over_samples`, `across` over systems and conditions, `method` how scores were made. From that
model alone `page` draws by the template and `drawings` the charts; `over_time` and `comparisons`
say how these look, `palette` in which colours.
"""
