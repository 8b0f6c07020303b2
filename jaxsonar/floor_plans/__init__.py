"""Floor plans: rooms of straight walls and thin poles, their junctions, and their GeoJSON files.

Entry points: ``room.Room``, ``room_geojson.load_room``, ``room_geojson.save_room``.
"""
