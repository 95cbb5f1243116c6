"""`placewise datasets`: data sets of the field, looked at, completed and made."""
