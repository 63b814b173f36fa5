"""Models at work: sessions, recurrent state, latency traces."""
