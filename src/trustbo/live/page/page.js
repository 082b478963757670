"use strict"
const at = (id) => document.getElementById(id)
const VIRIDIS = ["#440154", "#472d7b", "#3b528b", "#2c728e", "#21918c", "#28ae80", "#5ec962", "#addc30", "#fde725"]
const ROBOTS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"]
const number = (x, digits = 2) => (x === null || x === undefined ? "\u2013" : x.toFixed(digits).replace("-", "\u2212"))
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim()
let state = null
let map = null
let socket = null
let wait = 500 // ms until the next try to connect
let place = null // cell that was pointed at

/* The token stands in the part of the address that no server sees, and then in this tab alone. */
let token = new URLSearchParams(location.hash.slice(1)).get("token")
if (token) {
  sessionStorage.setItem("token", token)
  history.replaceState(null, "", location.pathname)
} else token = sessionStorage.getItem("token")

async function ask(path, options = {}) {
  const answer = await fetch(`api/${path}`, {...options, headers: {Authorization: `Bearer ${token}`}})
  const content = await answer.json()
  if (answer.status === 401) showDoor()
  if (!answer.ok) throw new Error(content.error)
  return content
}

function showDoor() {
  at("door").hidden = false
  document.querySelector("main").hidden = true
  at("link").textContent = token ? "wrong token" : "a token is needed"
  at("link").className = "lost"
}

async function connect() {
  if (!token) return showDoor()
  try { // a websocket that is refused does not say why
    await ask("state").then(show)
  } catch (error) {
    if (!at("door").hidden) return
    return again()
  }
  const address = new URL("api/live", location.href)
  address.protocol = address.protocol.replace("http", "ws")
  socket = new WebSocket(address, ["trustbo", `token.${token}`])
  socket.onopen = () => {
    wait = 500
    at("link").textContent = "connected"
    at("link").className = ""
  }
  socket.onmessage = ({data}) => {
    const content = JSON.parse(data)
    if ("phase" in content) show(content)
  }
  socket.onclose = again
}

function again() {
  at("link").textContent = "no connection: what is shown is old"
  at("link").className = "lost"
  for (const id of ["begin", "ok", "failed", "give-up", "reporter"]) at(id).disabled = true
  setTimeout(connect, wait)
  wait = Math.min(2 * wait, 5000)
}

async function tell(message) {
  at("refused").textContent = ""
  for (const id of ["begin", "ok", "failed", "give-up"]) at(id).disabled = true
  try {
    await ask("messages", {method: "POST", body: JSON.stringify(message)})
  } catch (error) {
    at("refused").textContent = error.message
  }
  await ask("state").then(show, () => {})
}

function show(next) {
  const other = state === null || state.mission !== next.mission
  state = next
  document.querySelector("main").hidden = false
  at("door").hidden = true
  const n = state.path.length - 1
  at("title").textContent = `Mission ${state.mission}, bound ${Math.min(state.bound, n)} of ${n}`
  document.title = `${state.phase} \u00b7 mission ${state.mission}`
  at("do").textContent = state.to_do
  const [ready, running] = [state.phase === "ready", state.phase === "running"]
  at("begin").hidden = running
  at("begin").textContent = `Begin bound ${state.bound}`
  at("begin").disabled = !ready || !state.planned
  at("ok").hidden = !running
  at("ok").disabled = !running
  at("failed").disabled = at("give-up").disabled = !(ready || running)
  if (!(ready || running)) at("why").hidden = true
  fill("alarms", state.alarms.map((text) => element("li", text)))
  at("few").textContent = state.filter || (state.n_draws < 20
    ? `The bands rest on ${Math.max(Math.round(state.n_draws), 1)} of the posterior's draws: read them as too narrow.` : "")
  showRobots()
  showReports()
  fill("log", state.log.toReversed().map(([t, text]) => {
    const line = element("li")
    line.append(element("time", new Date(1000 * t).toLocaleTimeString()), element("span", text))
    return line
  }))
  const more = [[state.refused, "refused"], [state.lost, "lost"], [state.idle, "between bounds, which count for none"]]
  at("counts").textContent = [`${state.taken} messages`, ...more.filter(([k]) => k).map(([k, what]) => `${k} ${what}`)].join("; ")
    + (state.last_refusal ? `. Last refusal: ${state.last_refusal}` : "")
  if (other) {
    const chosen = at("whose").value
    fill("whose", ["team", ...state.robots.map((robot) => robot.name)].map((name, i) => {
      const option = element("option", name)
      option.value = i === 0 ? "" : name
      return option
    }))
    at("whose").value = [...at("whose").options].some((option) => option.value === chosen) ? chosen : ""
    loadMap()
  } else drawMap()
}

function element(kind, text = "") {
  const made = document.createElement(kind)
  made.textContent = text
  return made
}

/* Only what changed, so that a screen reader is not told the same again. */
function fill(id, parts) {
  const text = parts.map((part) => part.textContent).join("\n")
  if (at(id).dataset.text === text && parts.length === at(id).children.length) return
  at(id).dataset.text = text
  at(id).replaceChildren(...parts)
}

/* --- map --- */

async function loadMap() {
  const robot = at("whose").value
  const query = new URLSearchParams({layer: at("layer").value, ...(robot ? {robot} : {})})
  try {
    map = await ask(`map?${query}`)
    drawMap()
  } catch { /* it comes with the next state */ }
}

function colour(share) {
  const x = Math.max(0, Math.min(1, share)) * (VIRIDIS.length - 1)
  const i = Math.min(Math.floor(x), VIRIDIS.length - 2)
  const [a, b] = [VIRIDIS[i], VIRIDIS[i + 1]].map((c) => [1, 3, 5].map((k) => parseInt(c.slice(k, k + 2), 16)))
  return `rgb(${a.map((v, k) => Math.round(v + (x - i) * (b[k] - v))).join(" ")})`
}

/* Canvas with as many pixels as the screen has there. */
function canvasOf(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1
  canvas.style.height = `${height}px`
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio)
    canvas.height = Math.round(height * ratio)
  }
  const pen = canvas.getContext("2d")
  pen.setTransform(ratio, 0, 0, ratio, 0, 0)
  pen.clearRect(0, 0, width, height)
  return pen
}

function drawMap() {
  if (map === null || state === null) return
  const [rows, cols] = map.shape
  const [high, wide] = map.cell
  const width = at("map").parentElement.clientWidth
  const scale = Math.min(width / (cols * wide), 0.8 * Math.max(window.innerHeight, 400) / (rows * high))
  const pen = canvasOf(at("map"), width, rows * high * scale)
  const left = (width - cols * wide * scale) / 2
  const x = (metres) => left + metres * scale
  const y = (metres) => (rows * high - metres) * scale
  const centre = ([r, c]) => [x((c + 0.5) * wide), y((rows - r - 0.5) * high)]
  const span = map.high - map.low || 1
  map.values.forEach((row, r) => row.forEach((value, c) => {
    pen.fillStyle = value === null ? css("--closed") : colour((value - map.low) / span)
    pen.fillRect(x(c * wide) - 0.25, y((rows - r) * high) - 0.25, wide * scale + 0.5, high * scale + 0.5)
  }))
  const {path, entered} = state
  const line = (cells, dashed) => {
    for (const [ink, thick] of [["#000", 5], ["#fff", 2.5]]) {
      pen.beginPath()
      cells.forEach((cell, i) => pen[i ? "lineTo" : "moveTo"](...centre(cell)))
      pen.strokeStyle = ink
      pen.lineWidth = thick
      pen.lineJoin = pen.lineCap = "round"
      pen.setLineDash(dashed ? [1, 8] : [])
      pen.stroke()
    }
    pen.setLineDash([])
  }
  line(path.slice(entered), true)
  if (entered) line(path.slice(0, entered + 1), false)
  if (state.phase === "running") {
    const [a, b] = [centre(path[entered]), centre(path[entered + 1])]
    pen.beginPath()
    pen.moveTo(...a)
    pen.lineTo(...b)
    pen.strokeStyle = "#ffe600"
    pen.lineWidth = 4
    pen.stroke()
  }
  mark(pen, ...centre(path[0]), 6, "#fff", 0)
  mark(pen, ...centre(path[path.length - 1]), 9, "#fff", 5)
  state.posts.forEach(([px, py], i) => mark(pen, x(px), y(py), 4.5, ROBOTS[i % ROBOTS.length], 4))
  Object.entries(state.poses).forEach(([name, [px, py]]) => {
    const i = state.robots.findIndex((robot) => robot.name === name)
    mark(pen, x(px), y(py), 5, i < 0 ? "#ffe600" : ROBOTS[i % ROBOTS.length], 0)
  })
  at("low").textContent = number(map.low)
  at("high").textContent = number(map.high)
  const bar = canvasOf(at("scale"), 96, 10)
  for (let i = 0; i < 96; i++) { bar.fillStyle = colour(i / 95); bar.fillRect(i, 0, 1.5, 10) }
  at("map-title").textContent = `${map.layer === "cost" ? "Cost" : "Trust"} of ${map.robot ?? "the team"}, cell by cell`
  at("place").textContent = place === null ? "" : `cell ${place}: ${number(map.values[place[0]]?.[place[1]])}`
  at("map").dataset.frame = JSON.stringify([left, scale])
}

/* A disc, or with corners a square (4) or a star (5). */
function mark(pen, x, y, size, ink, corners) {
  pen.beginPath()
  if (corners === 5) {
    for (let i = 0; i < 10; i++) {
      const [angle, reach] = [-Math.PI / 2 + i * Math.PI / 5, i % 2 ? 0.45 * size : size]
      pen.lineTo(x + reach * Math.cos(angle), y + reach * Math.sin(angle))
    }
    pen.closePath()
  } else if (corners === 4) pen.rect(x - 0.8 * size, y - 0.8 * size, 1.6 * size, 1.6 * size)
  else pen.arc(x, y, size, 0, 2 * Math.PI)
  pen.fillStyle = ink
  pen.strokeStyle = corners === 4 ? "#fff" : "#000"
  pen.lineWidth = 1.2
  pen.fill()
  pen.stroke()
}

function pointAt(event) {
  if (map === null) return
  const [left, scale] = JSON.parse(at("map").dataset.frame)
  const box = at("map").getBoundingClientRect()
  const [r, c] = [(event.clientY - box.top) / scale / map.cell[0], (event.clientX - box.left - left) / scale / map.cell[1]].map(Math.floor)
  place = r >= 0 && r < map.shape[0] && c >= 0 && c < map.shape[1] ? [r, c] : null
  drawMap()
}

/* --- robots --- */

function showRobots() {
  const {robots} = state
  if (at("robots").children.length !== robots.length) {
    at("robots").replaceChildren(...robots.map(() => {
      const made = element("div")
      made.className = "robot"
      made.append(element("h3"), document.createElement("canvas"), element("p"))
      return made
    }))
  }
  const [low, high] = limits()
  robots.forEach((robot, i) => {
    const [head, canvas, below] = at("robots").children[i].children
    at("robots").children[i].classList.toggle("low", state.alarms.some((text) => text.includes(`, ${robot.name}:`)))
    const now = element("span", robot.trust === undefined ? "" : `${number(robot.trust)} (${number(robot.low)} to ${number(robot.high)})`)
    head.replaceChildren(robot.name, now)
    const expected = robot.expected === undefined ? "" : `expected ${number(robot.expected)}`
    const measured = robot.n_ticks ? `contact ${number(robot.rate)} of ${robot.n_ticks} ticks` : state.phase === "running" ? "no ticks yet" : ""
    below.textContent = [measured, expected].filter(Boolean).join("; ")
    drawRobot(canvas, i, low, high)
  })
}

function limits() {
  const seen = [...state.trust, ...state.ahead].flat(2).concat(state.rates.flat()).filter((x) => x !== null)
  return [Math.max(-1, Math.min(0, ...seen)), Math.min(2, Math.max(1, ...seen))]
}

function drawRobot(canvas, i, low, high) {
  const [width, height] = [canvas.parentElement.clientWidth, 84]
  const pen = canvasOf(canvas, width, height)
  const n = Math.max(state.path.length - 1, state.trust.length, 1)
  const x = (k) => 26 + (width - 32) * k / n
  const y = (value) => 6 + (height - 12) * (high - Math.max(low, Math.min(high, value))) / (high - low)
  pen.font = "11px system-ui, sans-serif"
  pen.fillStyle = css("--quiet")
  pen.strokeStyle = css("--line")
  pen.lineWidth = 1
  for (const value of [0, 1]) {
    pen.fillText(String(value), 10, y(value) + 4)
    pen.beginPath()
    pen.moveTo(x(0), y(value))
    pen.lineTo(x(n), y(value))
    pen.stroke()
  }
  const past = state.trust.map((robots, k) => [k, robots[i]])
  const running = state.phase === "running" && state.robots[i].trust !== undefined
  const {trust, low: least, high: most} = state.robots[i]
  if (running) past.push([state.bound, [trust, least, most]])
  const k0 = state.trust.length - 1
  const ahead = state.ahead.map((robots, k) => [k0 + k + 1, robots[i]]).slice(running ? 1 : 0)
  const curve = (points, dashed) => {
    if (points.length === 0) return
    pen.beginPath()
    points.forEach(([k, [, l]], j) => pen[j ? "lineTo" : "moveTo"](x(k), y(l)))
    points.toReversed().forEach(([k, [,, h]]) => pen.lineTo(x(k), y(h)))
    pen.globalAlpha = dashed ? 0.5 : 1
    pen.fillStyle = css("--band")
    pen.fill()
    pen.globalAlpha = 1
    pen.beginPath()
    points.forEach(([k, [m]], j) => pen[j ? "lineTo" : "moveTo"](x(k), y(m)))
    pen.setLineDash(dashed ? [3, 4] : [])
    pen.strokeStyle = css("--curve")
    pen.lineWidth = 2
    pen.stroke()
    pen.setLineDash([])
  }
  curve(past, false)
  if (past.length) curve([past[past.length - 1], ...ahead], true)
  state.rates.forEach((rates, k) => {
    if (rates[i] !== null) mark(pen, x(k + 1), y(rates[i]), 3, css("--ink"), 0)
  })
}

/* --- reports of trust --- */

function showReports() {
  const {robots, reports, levels} = state
  const ends = levels ? {min: 1, max: levels, step: 1, value: (1 + levels) / 2} : {min: 0, max: 1, step: 0.01, value: 0.5}
  at("reporter").disabled = false
  if (at("sliders").children.length !== robots.length) {
    at("sliders").replaceChildren(...robots.map(({name}) => {
      const slider = Object.assign(document.createElement("input"), {type: "range", ...ends})
      slider.addEventListener("change", () => tell({report: {[name]: Number(slider.value)}, person: at("person").value}))
      const made = element("label")
      made.append(element("span", name), slider, element("output"))
      return made
    }))
  }
  robots.forEach((_, i) => {
    const given = reports.map((row) => row[i]).filter((x) => x !== null)
    at("sliders").children[i].lastChild.textContent = number(given.at(-1), levels ? 0 : 2)
  })
}

/* --- controls --- */

at("begin").addEventListener("click", () => tell({bound: state.bound}))
at("ok").addEventListener("click", () => tell({status: "ok", mission: state.mission}))
at("failed").addEventListener("click", () => { at("why").hidden = false; at("status").focus() })
at("back").addEventListener("click", () => { at("why").hidden = true })
at("why").addEventListener("submit", (event) => {
  event.preventDefault()
  at("why").hidden = true
  tell({status: at("status").value, note: at("note").value, mission: state.mission})
  at("note").value = ""
})
at("door").addEventListener("submit", (event) => {
  event.preventDefault()
  token = at("token").value.trim()
  sessionStorage.setItem("token", token)
  connect()
})
at("whose").addEventListener("change", loadMap)
at("layer").addEventListener("change", loadMap)
at("map").addEventListener("pointermove", pointAt)
at("map").addEventListener("pointerdown", pointAt)
const redraw = () => { if (state !== null) { drawMap(); showRobots() } }
window.addEventListener("resize", redraw)
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw)
connect()
