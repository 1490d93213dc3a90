"""Surveys that nobody made: a total station, prisms and boards, for calibration to be tried on."""
