"""The mast: kinematics of two axes, exact pointing, the error budget, and how sure a rig is."""
