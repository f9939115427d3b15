"""What a flight will give before it is flown."""
