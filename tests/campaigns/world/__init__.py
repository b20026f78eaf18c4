"""Random upgrades in a simulated world, judged by an oracle that looks into the devices' flash."""
