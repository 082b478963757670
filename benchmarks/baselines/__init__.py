"""Baselines of the benchmark, as their advocates would run them: one file each, and `paths`.

A baseline is a policy that learns by itself. Its factory takes no arguments, or the `truth`; the
policy has `learn(campaign, mission)` and `recommend(campaign)`, see docs/worlds.md. All have the
campaign's line of sight and admissible paths, and choose among these as they like.
"""
