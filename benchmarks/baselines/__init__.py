"""Baselines of the benchmark, with the settings that their authors recommend, one per file.

A baseline is a policy that learns from missions without a trust model. Its factory takes no
arguments, or the `truth`. The policy has the methods `learn(campaign, mission)` and
`recommend(campaign)`; see docs/worlds.md. All baselines use the line of sight and the admissible
paths of the campaign.
"""
