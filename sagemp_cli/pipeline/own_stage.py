"""A stage that a plugin brings as the graph runs it: what :mod:`sagemp_cli.stages` has a module for."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sagemp_cli.config.binding import Binding
from sagemp_cli.errors import ConfigError, SagempError
from sagemp_cli.plugins.stages import OwnStage

if TYPE_CHECKING:
    from sagemp_cli.pipeline.context import StageContext


@dataclass(frozen=True)
class OwnVerb:
    """Reads the stage's inputs, calls its function and writes the record that it gives."""

    stage: OwnStage

    def sections(self, config: Mapping[str, Any]) -> tuple[Binding, ...]:
        """The stage's own section: the function's arguments after context and inputs."""
        given = tuple(inspect.signature(self.stage.function).parameters)[:2]
        return (Binding(self.stage.section, self.stage.function, given=given),)

    def run(self, context: StageContext) -> Path:
        """Make the stage's file.

        Raises:
            ConfigError: the function fails, or gives something else than its record.
        """
        name, inputs = self.stage.name, context.inputs_of(self.stage.name)
        options = self.sections(context.config)[0].options(context.config)
        try:
            record = self.stage.function(context, inputs, **options)
        except SagempError:
            raise
        except Exception as e:
            raise ConfigError(f"stage '{name}' of {self.stage.function.__module__}: {type(e).__name__}: {e}") from e
        if type(record) is not self.stage.record:
            wanted = self.stage.record.__name__
            raise ConfigError(f"stage '{name}': gave {type(record).__name__}, its record is {wanted}")
        return context.write(name, record, tuple(inputs.values()))

    def draw(self, context: StageContext) -> None:
        """Nothing: there is no figure of what nobody here knows."""
