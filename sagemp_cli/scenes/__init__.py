"""Scenes: workspace, obstacles and goal as the safe set of a proof."""

from sagemp_cli.scenes.scene import Ball, Block, Obstacle, Scene, scene_from_mapping

__all__ = ["Ball", "Block", "Obstacle", "Scene", "scene_from_mapping"]
