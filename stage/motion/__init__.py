"""Moving subjects: tracking frames → optical flow → lit frames as they would look at one common time."""
