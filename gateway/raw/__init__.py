"""Messages of the wire for clients that run the policy themselves: queries, answers, publications and presence."""
