"""The lamps of a rig, switched for one picture after another; a module for each way to address them."""
