"""From tubes to verdicts: cells, executors, the verdict over a scene, and attacks on it."""
