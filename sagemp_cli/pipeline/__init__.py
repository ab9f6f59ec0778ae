"""The graph of stages and files as data (:data:`~sagemp_cli.pipeline.stage.STAGES`), and what stages share."""
