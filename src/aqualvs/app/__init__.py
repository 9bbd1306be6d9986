"""The command line, reports and the demo."""
