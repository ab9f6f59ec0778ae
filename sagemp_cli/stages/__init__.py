"""The verbs of the pipeline, one file a stage; the table of them is :data:`sagemp_cli.pipeline.stage.STAGES`."""
