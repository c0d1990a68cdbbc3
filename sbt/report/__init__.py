"""What a reader sees: figures, one self-contained page a campaign, replay, export."""
