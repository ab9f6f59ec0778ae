"""Attacks: rollouts that try to leave a tube or to violate the claim."""
