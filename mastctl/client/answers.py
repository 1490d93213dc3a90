"""The types of what a client answers: those of `mastctl.answers`, by the name that programs import."""

from mastctl.answers import *  # noqa: F403
