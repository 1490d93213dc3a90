"""The one way of commands: who asks, under which lease, what, until when, and with which result."""
