"""Jobs: their states, their table (SQLite or PostgreSQL), the dispatcher that runs them, and their event stream."""
