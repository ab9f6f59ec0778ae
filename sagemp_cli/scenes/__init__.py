"""Scenes: workspace, obstacles and goal as the safe set of a proof; landmarks; a picture of it all for planners."""

from sagemp_cli.scenes.frame import Frame
from sagemp_cli.scenes.objects import OBJECTS
from sagemp_cli.scenes.render import png_bytes, render
from sagemp_cli.scenes.scene import Ball, Block, Landmark, Obstacle, Scene, scene_from_mapping

__all__ = [
    "OBJECTS",
    "Ball",
    "Block",
    "Frame",
    "Landmark",
    "Obstacle",
    "Scene",
    "png_bytes",
    "render",
    "scene_from_mapping",
]
