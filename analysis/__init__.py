"""What reads finished runs: compare, plot, report, sweep, push."""
