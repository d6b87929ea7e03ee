"""The vehicles of a site, through its router: what `corridor fleet` does. The vehicle's own side is the sink
`service.sinks.fleet_sink`.
"""
