"""What learning agents take: demonstrations, lessons, policies, and adapters of libraries."""
