"""Operations: what runs, one at a time, and the records of what ran."""
