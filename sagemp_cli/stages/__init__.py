"""The pipeline's stages; the table of them is :data:`sagemp_cli.stages.stage.STAGES`."""
