"""The command `shakercal step`: releases of a load to models of the sensor."""
