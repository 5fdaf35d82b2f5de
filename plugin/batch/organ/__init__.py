"""An organ in all worlds of a batch on a device."""
