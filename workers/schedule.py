"""Learning-rate schedules."""

import math

from workers.settings import TrainSettings

PAPER_DECAY = 0.95  # per epoch (imperfect caches, section 4.4.4)
WARM_UP = 0.05
FINAL_SHARE = 0.01


def learning_rate(settings: TrainSettings, step: int, num_steps: int, steps_per_epoch: int) -> float:
    """Rate at a step: the paper's exponential decay, or one cosine cycle after a linear warm-up."""
    if settings.schedule == "paper":
        return settings.learning_rate * PAPER_DECAY ** (step // steps_per_epoch)
    warm = max(1, round(WARM_UP * num_steps))
    if step < warm:
        return settings.learning_rate * (step + 1) / warm
    progress = (step - warm) / max(1, num_steps - warm)
    cosine = 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))
    return settings.learning_rate * (FINAL_SHARE + (1 - FINAL_SHARE) * cosine)
