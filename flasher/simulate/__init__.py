"""Seeded campaigns of simulated upgrades: plans of faults, an oracle, shrinking, planted mistakes.

`plan` has the text of a plan, `draw` the plan of a seed. `play` runs the production upgrade on the
simulated bus of a plan (`bus`), against the device model or one written from the document alone
(`independent`); `oracle` judges. `planting` plants mistakes, to show that a campaign finds them.
"""
