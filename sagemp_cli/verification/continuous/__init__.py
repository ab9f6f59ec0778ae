"""Verdicts about loops in continuous time: requirements judged on flows, attacked, and proved cell by cell."""
