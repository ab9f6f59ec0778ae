"""The vision-language planner: prompts, pictures, providers, untrusted answers, references; and its local stand-in."""

from sagemp_cli.planners.vlm.answer import AnswerError, waypoints_of
from sagemp_cli.planners.vlm.planner import VLM
from sagemp_cli.planners.vlm.service import ServiceError
from sagemp_cli.planners.vlm.waypoints import Drive, reference_of

__all__ = ["VLM", "AnswerError", "Drive", "ServiceError", "reference_of", "waypoints_of"]
