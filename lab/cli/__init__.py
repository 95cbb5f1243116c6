"""Commands of the lab, which `services.cli.main` registers where the lab is installed."""
