"""Setting a rig up: what a machine lacks, cameras, boards to print, a new rig."""
