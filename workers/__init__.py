"""Mitsuba and the stages: one file a stage, and the nouns they share."""
