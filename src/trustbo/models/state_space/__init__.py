"""The state space that trust models share, filtered, smoothed and simulated."""
