"""The lab: trains, compares and measures models. The service never imports it; see docs/lab.md."""
