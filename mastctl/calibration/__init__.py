"""From a survey folder to a mast file and a report that says whether to trust it."""
