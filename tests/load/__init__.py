"""Load tests: run by hand, never collected (`python -m tests.load.frames --help`)."""
