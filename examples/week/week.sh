# A week of eight missions on one ground, at a shell. Lines that begin with "robots" are the drives;
# in this example, robots.py simulates them and writes the logs.

trustbo new week --dem dem.tif --dsm dsm.tif --shape 10,10 --max-slope 38 --names alpha,bravo,charlie --place camp=9,0 --place hill=0,9 --place ford=x=1802180,y=5467470 --columns columns.toml

# Monday: a first look, and the first mission.
trustbo ways week camp hill --picture ways.png
trustbo ask week camp hill --nav2 nav2-1 --geojson path-1.geojson
robots week legs-1.csv --day 2026-05-04
trustbo tell week legs-1.csv

# Tuesday: another course on the same ground; the log has poses and detections.
trustbo ask week hill ford --nav2 nav2-2 --geojson path-2.geojson
robots week poses-2.csv --detections detections-2.csv --day 2026-05-05
trustbo tell week poses-2.csv --detections detections-2.csv --tick 0.5

# Wednesday: charlie stays at home.
trustbo ask week ford camp --robots alpha,bravo
robots week legs-3.csv --day 2026-05-06
trustbo tell week legs-3.csv

# Thursday: the lead gets stuck in its ninth bound, in mud and not on a slope; the cell is closed.
trustbo ask week camp hill
robots week legs-4.csv --day 2026-05-07 --stuck 9
trustbo tell week legs-4.csv --cause mud
trustbo close week STUCK --reason mud --until 2099-05-11
trustbo ask week camp hill
robots week legs-5.csv --day 2026-05-07
trustbo tell week legs-5.csv

# Friday: the operator drives another way than planned, and one log is wrong.
trustbo ask week hill camp
robots week legs-6.csv --day 2026-05-08 --way 1
trustbo tell week legs-6.csv
robots week legs-5b.csv --again legs-5.csv
trustbo correct week 5 legs-5b.csv --reason "clock of bravo"
trustbo ask week ford hill
trustbo fail week collision

# Saturday: the last mission, and what the week has shown.
trustbo reopen week 1 --reason "dry again"
trustbo ask week ford hill
robots week legs-8.csv --day 2026-05-09
trustbo tell week legs-8.csv
trustbo status week
trustbo ways week camp hill
trustbo report week --out report.html
trustbo export week --format geotiff geojson csv nav2 --out maps
