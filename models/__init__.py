"""Networks, transfer functions, losses and metrics: torch and numpy in, torch and numpy out.

Nothing here reads or writes a file or knows a renderer; `storage` hands in weights and images, `workers` runs
the stages.
"""
