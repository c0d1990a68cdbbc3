"""How it runs: the only room that knows libsumo."""
