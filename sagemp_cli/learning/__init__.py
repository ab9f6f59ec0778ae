"""What every training shares: the one loop that fits a module to a loss, and its checkpoints."""
