"""The store of a campaign: its file, its rows as columns, and recorded tables."""
