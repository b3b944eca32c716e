"""Assets as OpenUSD."""
