"""The live view: what the daemon publishes, shown in Foxglove or Lichtblick on this machine."""
