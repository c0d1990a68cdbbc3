"""The live view in a browser: `sumo-sbt serve` shows the campaigns below some folders, also while they run."""
