"""Recordings: MCAP files of pictures, frames, joints, targets, residuals, commands, faults and state."""
