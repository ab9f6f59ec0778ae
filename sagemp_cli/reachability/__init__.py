"""Reachability: propagators, relaxations, partitions, verdicts."""
