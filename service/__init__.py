"""What people touch: the command line, the HTTP endpoint, the report. Nothing here renders or trains."""
