"""`placewise datasets`: check, complete and generate place recognition data sets."""
