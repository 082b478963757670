"use strict"
const scene = JSON.parse(document.getElementById("scene").textContent)
const [rows, cols] = scene.shape
const [cellHeight, cellWidth] = scene.cell
const every = Array.from({length: rows * cols}, (_, i) => [Math.floor(i / cols), i % cols])
const centres = {
  x: every.map(([, c]) => (c + 0.5) * cellWidth), y: every.map(([r]) => (rows - r - 0.5) * cellHeight),
}
const at = (id) => document.getElementById(id)
const MINUS = "\u2212"
const text = (x) => (x === null ? "\u2013" : Number(x.toPrecision(3)).toString().replace("-", MINUS))
const withSd = (x, sd) => { // with the digits that two of the sd allow
  if (x === null || !(sd > 0)) return text(x)
  const digits = Math.max(1 - Math.floor(Math.log10(sd)), 0)
  return `${x.toFixed(digits)} \u00b1 ${sd.toFixed(digits)}`.replace("-", MINUS)
}
const unknown = (values) => values.map((x) => (x === null ? NaN : x))
const mean = (values) => {
  const known = values.filter((x) => x !== null)
  return known.length ? known.reduce((a, b) => a + b) / known.length : NaN
}

async function embed(name) {
  const item = JSON.parse(at(`${name}-model`).textContent)
  const views = await Bokeh.embed.embed_item(item, name)
  return views.roots[0].model
}

/* A notebook's theme, where it has one, else that of the system. */
function isDark() {
  try {
    if (window.parent !== window) {
      const own = window.parent.document.body
      if ("jpThemeLight" in own.dataset) return own.dataset.jpThemeLight === "false"
      if (own.classList.contains("vscode-dark")) return true
      if (own.classList.contains("vscode-light")) return false
      if (own.dataset.theme === "dark" || own.dataset.theme === "light") return own.dataset.theme === "dark"
    }
  } catch { /* another origin */ }
  return window.matchMedia("(prefers-color-scheme: dark)").matches
}

async function start() {
  document.documentElement.toggleAttribute("data-dark", isDark())
  const map = await embed("map")
  const chart = await embed("chart")
  const part = (name) => map.document.get_model_by_name(name) ?? chart.document.get_model_by_name(name)
  const fill = (name, columns) => { part(name).data = columns }
  const extreme = scene.steps.flatMap((step) => step.contact.map(mean)).filter((x) => !Number.isNaN(x))
  const least = extreme.length ? Math.min(...extreme, 0.999) : 0
  part("contact").low = least
  at("contact").style.background = `linear-gradient(to right, ${part("contact").palette.join(",")})`
  at("contact-key").textContent = `contact of a bound, ${text(Math.floor(100 * least) / 100)} to 1`

  const layer = () => scene.layers[Number(at("layer").value)]
  const number = () => Number(at("step").value) - 1
  const step = () => scene.steps[number()]
  const values = (one) => one.maps[one.maps.length > 1 ? number() : 0]
  let chosen = null // {cell} or {bound}
  let moved = {} // positions of posts that were dragged, by "bound robot"
  let dragged = null // [bound, robot]
  const post = (k, i) => moved[[k, i]] ?? step().posts[k][i]

  function showLayer() {
    const one = layer()
    const colours = part("colours")
    colours.setv({palette: scene.palettes[one.colours], low: one.low, high: one.high})
    fill("cells", {...centres, value: unknown(values(one))})
    at("map-title").textContent = one.label
    showNumbers()
  }

  const marks = (points) => ({
    marker: points.map((i) => scene.marks[i][0]), colour: points.map((i) => scene.marks[i][1]),
  })

  function showPosts() {
    const stands = (step().posts ?? []).flatMap((robots, k) => robots.map((_, i) => [...post(k, i), i]))
    const known = stands.filter((p) => p[0] !== null)
    fill("posts", {x: known.map((p) => p[0]), y: known.map((p) => p[1]), ...marks(known.map((p) => p[2]))})
  }

  /* Percent of the lead's way in bound k that robot i would see from a position; null where it cannot stand. */
  function seenFrom(k, i, [x, y]) {
    const map = step().overwatch[k]
    const nearest = (values, value) => values.reduce((best, v, j) => (
      Math.abs(v - value) < Math.abs(values[best] - value) ? j : best), 0)
    const [c, r] = [nearest(map.x, x), nearest(map.y, y)]
    const apart = Math.abs(map.x[1] - map.x[0])
    if (Math.abs(map.x[c] - x) > apart || Math.abs(map.y[r] - y) > apart) return null
    const percent = map.percent[Math.min(i, map.percent.length - 1)][r * map.x.length + c]
    return percent < 0 ? null : percent
  }

  function showOverwatch() {
    const maps = step().overwatch
    const k = chosen?.bound
    const none = {x: [], y: [], seen: [], width: [], height: []}
    part("overwatch map").visible = Boolean(maps) && k !== undefined && (at("overwatch")?.checked || dragged !== null)
    if (!part("overwatch map").visible) return fill("overwatch", none)
    const {x, y, percent} = maps[k]
    const own = percent[Math.min(dragged?.[1] ?? 0, percent.length - 1)]
    const points = own.map((p, j) => [x[j % x.length], y[Math.floor(j / x.length)], p / 100]).filter((p) => p[2] >= 0)
    fill("overwatch", {
      x: points.map((p) => p[0]), y: points.map((p) => p[1]), seen: points.map((p) => p[2]),
      width: points.map(() => Math.abs(x[1] - x[0])), height: points.map(() => Math.abs(y[1] - y[0])),
    })
  }

  function showStep() {
    const {title, note, heading, path, stops, posts, contact, trust} = step()
    at("title").textContent = title
    at("note").textContent = note
    const x = stops.map((stop) => stop[0])
    const y = stops.map((stop) => stop[1])
    const n = path.length - 1
    const rates = Array.from({length: n}, (_, k) => (k < contact.length ? mean(contact[k]) : NaN))
    fill("bounds", {x0: x.slice(0, -1), y0: y.slice(0, -1), x1: x.slice(1), y1: y.slice(1), contact: rates})
    fill("ends", {x: [x[0], x[n]], y: [y[0], y[n]], marker: ["circle", "star"], size: [10, 17]})
    moved = {}
    showPosts()
    const dots = contact.flatMap((robots, k) => robots.map((rate, i) => [k, rate, i])).filter((d) => d[1] !== null)
    const aside = (i) => 0.12 * (i - (scene.robots.length - 1) / 2)
    fill("rates", {
      bound: dots.map(([k, , i]) => k + 1 + aside(i)), rate: dots.map((d) => d[1]), ...marks(dots.map((d) => d[2])),
    })
    const single = n === 1 // a band of one bound would not be seen
    const along = {bound: single ? [0.7, 1.3] : trust[0].map((_, k) => k + 1)}
    trust.forEach((q, i) => { along[`q${i}`] = unknown(single ? [q[0], q[0]] : q) })
    fill("trust", along)
    at("chart-title").textContent = heading
    if (chosen?.bound >= n) chosen = null
    if (layer().maps.length > 1) showLayer()
    showNumbers()
  }

  function table(pairs) {
    const made = document.createElement("table")
    for (const [name, value, bold] of pairs) {
      const row = made.insertRow()
      if (bold) row.className = "chosen"
      const head = document.createElement("th")
      head.scope = "row"
      head.textContent = name
      row.append(head)
      row.insertCell().textContent = value
    }
    return made
  }

  function ofCell([r, c]) {
    const i = r * cols + c
    const spreads = new Set(scene.layers.map((one) => one.sd))
    const byName = Object.fromEntries(scene.layers.map((one) => [one.name, one]))
    return scene.layers.filter((one) => !spreads.has(one.name)).map((one) => {
      const sd = byName[one.sd]
      const own = values(one)[i]
      return [one.label, sd ? withSd(own, values(sd)[i]) : text(own), one === layer() || (sd && sd === layer())]
    })
  }

  function ofBound(k) {
    const {contact, trust, numbers} = step()
    const rates = (contact[k] ?? []).map((rate, i) => [`contact rate, ${scene.robots[i]}`, text(rate)])
    const pairs = Number.isNaN(mean(contact[k] ?? [])) ? [] : rates
    if (trust[2][k] !== null) {
      pairs.push(["team's trust", `${text(trust[2][k])} (90 %: ${text(trust[0][k])} to ${text(trust[4][k])})`])
    }
    for (const [name, texts] of Object.entries(numbers)) if (texts[k]) pairs.push([name, texts[k]])
    for (const [i, robot] of (step().overwatch ? scene.robots : []).entries()) {
      const percent = seenFrom(k, i, post(k, i))
      const where = [k, i] in moved ? " from where it was moved" : ""
      pairs.push([`${robot} sees${where}`, percent === null ? "cannot stand there" : `${percent} % of the lead's way`])
    }
    return pairs
  }

  function showNumbers() {
    const {path, stops, posts} = step()
    showOverwatch()
    const empty = {x0: [], y0: [], x1: [], y1: []}
    if (chosen?.bound !== undefined) {
      const k = chosen.bound
      const [[x0, y0], [x1, y1]] = [stops[k], stops[k + 1]]
      at("place").textContent = `Bound ${k + 1}, ${path[k]} to ${path[k + 1]}`
      at("numbers").replaceChildren(table(ofBound(k)))
      fill("bound", {x0: [x0], y0: [y0], x1: [x1], y1: [y1]})
      const robots = (posts?.[k] ?? []).map((_, i) => [...post(k, i), scene.marks[i][1]])
      const seen = robots.filter((p) => p[0] !== null)
      fill("sight", {
        x0: seen.map((p) => p[0]), y0: seen.map((p) => p[1]), x1: seen.map(() => x1), y1: seen.map(() => y1),
        colour: seen.map((p) => p[2]),
      })
      fill("chosen", {bound: [k + 1]})
      fill("cell", {x: [], y: []})
      return
    }
    fill("bound", empty)
    fill("sight", {...empty, colour: []})
    fill("chosen", {bound: []})
    if (chosen === null) {
      at("place").textContent = "Numbers"
      const hint = document.createElement("p")
      const drag = step().overwatch ? " Drag a post to read what the robot would see from elsewhere." : ""
      hint.textContent = `Point at a cell, or at a bound of the path; on a touch screen, tap it.${drag}`
      at("numbers").replaceChildren(hint)
      fill("cell", {x: [], y: []})
      return
    }
    const [r, c] = chosen.cell
    at("place").textContent = `Cell ${r},${c}`
    at("numbers").replaceChildren(table(ofCell(chosen.cell)))
    fill("cell", {x: [(c + 0.5) * cellWidth], y: [(rows - r - 0.5) * cellHeight]})
  }

  function choose(next) {
    const same = JSON.stringify(next) === JSON.stringify(chosen)
    chosen = next
    if (!same) showNumbers()
  }

  /* Distance from a point to the part of a line between two others. */
  function away(x, y, [x0, y0], [x1, y1]) {
    const [dx, dy] = [x1 - x0, y1 - y0]
    const share = Math.max(0, Math.min(1, ((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy || 1)))
    return Math.hypot(x - x0 - share * dx, y - y0 - share * dy)
  }

  /* Take up the post next to the pointer, within 12 pixels. */
  function dragFrom({x, y}) {
    const {posts, overwatch} = step()
    if (!overwatch || !at("posts")?.checked) return
    const away = posts.flatMap((robots, k) => robots.map((_, i) => {
      const [px, py] = post(k, i)
      return [Math.hypot(px - x, py - y), k, i]
    })).sort((a, b) => a[0] - b[0])[0]
    const metres = (map.x_range.end - map.x_range.start) / map.inner_width
    if (away[0] > 12 * metres) return
    dragged = away.slice(1)
    chosen = {bound: dragged[0]}
    showNumbers()
  }

  function dragTo({x, y}) {
    if (dragged === null) return
    moved[dragged] = [x, y]
    showPosts()
    showNumbers()
  }

  function dragEnd() {
    dragged = null
    showOverwatch()
  }

  function pointAtMap({x, y}) {
    if (dragged !== null) return
    const {stops} = step()
    const near = stops.slice(1).map((stop, k) => away(x, y, stops[k], stop))
    const k = near.indexOf(Math.min(...near))
    if (near[k] < 0.14 * Math.min(cellWidth, cellHeight)) return choose({bound: k})
    const [r, c] = [rows - 1 - Math.floor(y / cellHeight), Math.floor(x / cellWidth)]
    if (r >= 0 && r < rows && c >= 0 && c < cols) choose({cell: [r, c]})
  }

  function pointAtChart({x}) {
    const k = Math.round(x) - 1
    if (k >= 0 && k < step().path.length - 1) choose({bound: k})
  }

  function paint() {
    document.documentElement.toggleAttribute("data-dark", isDark())
    const style = getComputedStyle(document.documentElement)
    const names = ["--ink", "--line", "--median", "--closed"]
    const [ink, line, median, closed] = names.map((name) => style.getPropertyValue(name).trim())
    part("colours").nan_color = closed
    for (const plot of [map, chart]) {
      for (const axis of [...plot.below, ...plot.left]) {
        const names = ["axis_label_text_color", "major_label_text_color", "axis_line_color", "major_tick_line_color"]
        for (const name of names) if (name in axis.properties) axis[name] = ink
      }
      for (const grid of plot.center) if ("grid_line_color" in grid.properties) grid.grid_line_color = line
    }
    part("median").glyph.line_color = median
  }

  for (const event of ["mousemove", "tap"]) {
    map.on_event(event, pointAtMap)
    chart.on_event(event, pointAtChart)
  }
  map.on_event("panstart", dragFrom)
  map.on_event("pan", dragTo)
  map.on_event("panend", dragEnd)
  at("overwatch")?.addEventListener("change", showOverwatch)
  at("layer").addEventListener("change", showLayer)
  at("step").addEventListener("input", showStep)
  const toggle = (id, name) => at(id)?.addEventListener("change", (event) => {
    const drawn = part(name)
    if (drawn !== null) drawn.visible = event.target.checked
  })
  toggle("relief", "relief")
  toggle("posts", "post marks")
  if (part("relief") === null) at("relief").parentElement.remove()
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint)
  const shape = Math.min((rows * cellHeight) / (cols * cellWidth), 1.35)
  const fitMap = () => { // 62 and 128 pixels are of axes, tools and the colour bar
    const height = Math.round(Math.max((at("map").clientWidth - 62) * shape, 70) + 128)
    if (height !== map.height) map.height = height
  }
  new ResizeObserver(fitMap).observe(at("map"))
  fitMap()
  paint()
  showLayer()
  showStep()
  if (window.frameElement) { // a notebook's frame has no scroll bar of its own
    const fit = () => { window.frameElement.style.height = `${document.documentElement.offsetHeight + 4}px` }
    new ResizeObserver(fit).observe(document.body)
  }
  document.documentElement.dataset.ready = "yes"
}

start()
