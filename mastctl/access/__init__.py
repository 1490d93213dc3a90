"""Who may come in from beyond this machine: tokens, sessions of pages, and what is done about guessing."""
