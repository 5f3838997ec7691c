"""Results that other toolkits have written, as recordings of a trace."""
