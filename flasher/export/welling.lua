-- Wireshark dissector for the Welling drive system on CAN (dialects Welling and MOTINOVA).
--
-- Made by `flasher export wireshark`; what the messages are is in the tables below. Load it with
-- `wireshark -X lua_script:welling.lua FILE`, or put it into the folder of personal Lua plugins
-- (Help > About Wireshark > Folders). Needs Wireshark 4.0 or later.

local T = {} --[[ tables ]]

local welling = Proto("welling", "Welling drive system")
set_plugin_info({version = T.version, description = "Welling drive system on CAN"})

-- Preference ------------------------------------------------------------------------------------

local choices = {}
for number, dialect in ipairs(T.dialects) do
  choices[number] = {dialect.name, dialect.text, number}
end
welling.prefs.dialect = Pref.enum(
  "Dialect", 1, "Messages that this dialect does not have are marked", choices)

-- Fields ----------------------------------------------------------------------------------------

local F = {}       -- by filter name, without "welling."
local fields = {}

local function declare(name, make, ...)
  if not F[name] then
    F[name] = make("welling." .. name, ...)
    fields[#fields + 1] = F[name]
  end
end

declare("kind", ProtoField.string, "Kind")
declare("message", ProtoField.string, "Message")
declare("sender", ProtoField.string, "Sender")
declare("receiver", ProtoField.string, "Receiver")
declare("mode", ProtoField.uint8, "Mode", base.HEX, T.modes)
declare("length", ProtoField.uint8, "Length of command and data", base.DEC)
declare("command", ProtoField.uint16, "Command", base.HEX)
declare("data", ProtoField.bytes, "Data")
declare("crc", ProtoField.uint32, "CRC", base.HEX)
declare("crc.expected", ProtoField.uint32, "CRC computed", base.HEX)
declare("crc.ok", ProtoField.bool, "CRC is right")
declare("in_dialect", ProtoField.bool, "In the chosen dialect")
declare("problem", ProtoField.string, "Problem")
declare("damage", ProtoField.string, "Damage")
declare("damage.bytes", ProtoField.bytes, "Bytes that are no message")
declare("begin", ProtoField.framenum, "First frame", base.NONE)
declare("frames", ProtoField.uint32, "CAN frames", base.DEC)
declare("part", ProtoField.bool, "Part of a message")
declare("end", ProtoField.framenum, "Completed in", base.NONE)
declare("upgrade", ProtoField.uint32, "Upgrade", base.DEC)
declare("attempt", ProtoField.uint32, "Attempt", base.DEC)
declare("copy", ProtoField.uint32, "Sent for the time", base.DEC)
declare("answer_to", ProtoField.framenum, "Answer to", base.NONE, frametype.REQUEST)
declare("answer_in", ProtoField.framenum, "Answered in", base.NONE, frametype.RESPONSE)
declare("answer_ms", ProtoField.double, "Answer time (ms)")

local UNSIGNED = {ProtoField.uint8, ProtoField.uint16, ProtoField.uint24, ProtoField.uint32}
local SIGNED = {ProtoField.int8, ProtoField.int16, ProtoField.int24, ProtoField.int32}

local function declare_number(name, label, make, unit)
  if unit ~= "" then
    declare(name, make, label, base.UNIT_STRING + base.DEC, {" " .. unit})
  else
    declare(name, make, label, base.DEC)
  end
end

local function declare_fields(of)
  for _, f in ipairs(of.fields) do
    if f.must_be then
      -- is not shown
    elseif f.kind == "number" then
      local make = f.offset ~= 0 and ProtoField.int32 or (f.signed and SIGNED or UNSIGNED)[f.size]
      declare_number(f.filter, f.label, make, f.unit)
    elseif f.kind == "numbers" then
      declare_number(f.filter, f.label, UNSIGNED[f.each], f.unit)
    elseif f.kind == "address" then
      declare(f.filter, UNSIGNED[f.size], f.label, base.HEX)
    elseif f.kind == "flags" then
      declare(f.filter, UNSIGNED[f.size], f.label, base.HEX)
      for _, bit in ipairs(f.bits) do
        declare(f.filter .. "." .. bit.name, ProtoField.bool, bit.text, 8 * f.size, nil, bit.mask)
      end
    elseif f.kind == "bytes" or f.kind == "reserved" then
      declare(f.filter, ProtoField.bytes, f.label)
    else
      declare(f.filter, ProtoField.string, f.label)
    end
  end
end

local ITEMS, ROWS = {}, {}  -- by id and command; by command
for _, item in ipairs(T.items) do
  declare_fields(item)
  ITEMS[item.id * 65536 + item.command] = item
end
for _, row in ipairs(T.rows) do
  declare_fields(row)
  ROWS[row.command] = row
end
welling.fields = fields


local E = {}
local experts = {}
for name, of in pairs({
  nak = {"The device refused it (NAK)", expert.group.RESPONSE_CODE, expert.severity.WARN},
  faults = {"The battery reports faults", expert.group.RESPONSE_CODE, expert.severity.WARN},
  repeated = {"Sent once more", expert.group.SEQUENCE, expert.severity.NOTE},
  crc = {"Wrong CRC", expert.group.CHECKSUM, expert.severity.ERROR},
  damaged = {"Bytes that are no message", expert.group.MALFORMED, expert.severity.ERROR},
  malformed = {"Not as the document has it", expert.group.PROTOCOL, expert.severity.WARN},
  unknown = {"In no document", expert.group.UNDECODED, expert.severity.NOTE},
  dialect = {"Not in the chosen dialect", expert.group.PROTOCOL, expert.severity.NOTE},
  foreign_tool = {"A second tool", expert.group.PROTOCOL, expert.severity.WARN},
}) do
  E[name] = ProtoExpert.new("welling.expert." .. name, of[1], of[2], of[3])
  experts[#experts + 1] = E[name]
end
welling.experts = experts

-- CRC (appendix 1): each byte goes into the low end of the register, then four table steps. ----------
-- Two tables take the four steps at once: one for each half of the register.

local xor, band, shift
if _VERSION == "Lua 5.1" or _VERSION == "Lua 5.2" then
  local library = bit32 or bit  -- the results of the second one are signed; the tables stand it
  xor, band, shift = library.bxor, library.band, library.rshift
else
  -- Lua 5.2 does not read these operators.
  xor = load("return function(a, b) return a ~ b end")()
  band = load("return function(a, b) return a & b end")()
  shift = load("return function(a, b) return a >> b end")()
end

local CRC = {{}, {}, {}, {}}
for byte = 0, 255 do
  local register = byte * 0x1000000
  for _ = 1, 8 do
    local top = register >= 0x80000000
    register = (register * 2) % 0x100000000
    if top then register = xor(register, 0x04C11DB7) % 0x100000000 end
  end
  CRC[1][byte] = register
end
for step = 2, 4 do
  for byte = 0, 255 do
    local register = CRC[step - 1][byte]
    local top = math.floor(register / 0x1000000)
    CRC[step][byte] = xor((register * 256) % 0x100000000, CRC[1][top]) % 0x100000000
  end
end
local UPPER, LOWER = {}, {}
for high = 0, 255 do
  for low = 0, 255 do
    UPPER[high * 256 + low] = xor(CRC[4][high], CRC[3][low]) % 0x100000000
    LOWER[high * 256 + low] = xor(CRC[2][high], CRC[1][low]) % 0x100000000
  end
end

local function crc_add(register, text)
  for _, byte in ipairs({text:byte(1, -1)}) do
    register = xor(register, byte)
    register = xor(UPPER[band(shift(register, 16), 0xFFFF)], LOWER[band(register, 0xFFFF)])
  end
  return register
end

local CRC_BEGIN = {}  -- by id: the register after the header and the id
for id in pairs(T.ids) do
  CRC_BEGIN[id] = crc_add(0xFFFFFFFF, T.header .. string.char(math.floor(id / 256), id % 256))
end

-- Reassembly: a stream of bytes for each id of each interface, as flasher.protocol.wire reads it. -----

local HEADER, TAIL = T.header, T.tail
local HEAD_SIZE = T.prefix_size + 2
local REASON = T.reasons

local function big_endian(text, first, last)
  local value = 0
  for at = first, last do value = value * 256 + text:byte(at) end
  return value
end

local function little_endian(text)
  local value = 0
  for at = #text, 1, -1 do value = value * 256 + text:byte(at) end
  return value
end

local function flush_junk(s, found)
  if s.junk ~= "" then
    found[#found + 1] = {id = s.id, reason = REASON.JUNK, wire = s.junk}
    s.junk = ""
  end
end

-- Moves everything before the next header to the junk; false when no header may be left.
local function align(s)
  if s.buffer:sub(1, 2) ~= HEADER then
    local start = s.buffer:find(HEADER, 1, true)
    if not start then
      start = #s.buffer + 1
      if s.buffer:sub(-1) == HEADER:sub(1, 1) then start = start - 1 end
    end
    s.junk = s.junk .. s.buffer:sub(1, start - 1)
    s.buffer = s.buffer:sub(start)
  end
  s.needed = #s.buffer >= 2 and HEAD_SIZE or 2
  return s.buffer ~= ""
end

-- The candidate at the front is no message: only its header is given up, the rest is scanned.
local function damage(s, reason, size, found)
  flush_junk(s, found)
  found[#found + 1] = {id = s.id, reason = reason, wire = s.buffer:sub(1, size)}
  s.buffer = s.buffer:sub(3)
  align(s)
  s.junk = ""
end

local function computed_crc(id, wire)
  return crc_add(CRC_BEGIN[id], wire:sub(3, -6)) % 0x100000000
end

local function scan(s, found)
  while align(s) and #s.buffer >= s.needed do
    local length = s.buffer:byte(T.prefix_size)
    local size = T.overhead_size + length
    if s.buffer:byte(HEAD_SIZE) ~= length - 2 then
      damage(s, REASON.BAD_LENGTH, HEAD_SIZE, found)
    elseif #s.buffer < size then
      s.needed = size
      break
    else
      local wire = s.buffer:sub(1, size)
      if wire:sub(-1) ~= TAIL then
        damage(s, REASON.BAD_TAIL, size, found)
      elseif computed_crc(s.id, wire) ~= big_endian(wire, size - 4, size - 1) then
        damage(s, REASON.BAD_CRC, size, found)
      else
        flush_junk(s, found)
        s.buffer = s.buffer:sub(size + 1)
        found[#found + 1] = {
          id = s.id, wire = wire, mode = wire:byte(3), command = big_endian(wire, 5, 6)}
      end
    end
  end
  if #s.junk >= T.message_max_size then flush_junk(s, found) end
end

-- What has waited too long is dropped (R12).
local function cut_short(s, found)
  s.due = nil
  while s.buffer ~= "" do
    if #s.buffer > 2 then
      damage(s, REASON.INCOMPLETE, #s.buffer, found)
      scan(s, found)
    else
      s.junk = s.junk .. s.buffer
      s.buffer = ""
    end
  end
  flush_junk(s, found)
  s.needed = 2
end

-- What a message says --------------------------------------------------------------------------------

local IS_REQUEST, IS_ANSWER = {}, {}  -- ids between the tool and a device, with the other one of both
for _, target in ipairs(T.targets) do
  IS_REQUEST[target.request_id] = target.answer_id
  IS_ANSWER[target.answer_id] = target.request_id
end
local REPORT
for value, name in pairs(T.modes) do
  if name == "report" then REPORT = value end
end

local function mode_problem(item, of)
  return string.format("mode is %02X, not %02X", item.mode, of.mode)
end

-- What breaks the form of a message of the upgrade; nil when nothing does.
local function problem_of(row, data)
  local at = 1
  for _, f in ipairs(row.fields) do
    local raw = data:sub(at, at + f.size - 1)
    at = at + f.size
    local is_wrong = (f.must_be and raw ~= f.must_be) or (f.known and not f.known[raw])
      or (f.least and little_endian(raw) < f.least)
    if is_wrong then return f.label .. " is not what the document has there" end
  end
end

local function judge(item)
  item.data = item.wire:sub(HEAD_SIZE + 1, -6)
  local known = ITEMS[item.id * 65536 + item.command]
  if known then
    item.of, item.title = known, known.title
    item.kind = item.mode == known.mode and "message" or "malformed"
    if item.kind == "malformed" then item.problem = mode_problem(item, known) end
    item.is_alarm = item.kind == "message" and known.is_alarm and item.data:find("[^%z]") ~= nil
    return
  end
  item.kind, item.title = "unknown", T.titles.unknown
  local row = ROWS[item.command]
  if row and (IS_REQUEST[item.id] or IS_ANSWER[item.id]) then
    local problem = item.mode ~= row.mode and mode_problem(item, row) or problem_of(row, item.data)
    if problem then
      item.kind, item.title, item.problem = "malformed", T.titles.malformed, problem
    elseif (row.mode == REPORT) == (IS_ANSWER[item.id] ~= nil) then
      item.kind, item.title, item.of = "message", row.title, row
    end
  end
end

local function is_in_dialect(item)
  local dialect = T.dialects[welling.prefs.dialect]
  local known = ITEMS[item.id * 65536 + item.command]
  if known then return known.dialects[dialect.name] == true end
  local row = ROWS[item.command]
  return dialect.has_upgrade or row == nil or not row.is_upgrade
end

-- The course of an upgrade, as flasher.trace.observed_upgrade follows it ------------------------------

local COMMAND = T.commands
local BEGINS = {
  [COMMAND.RESET] = true, [COMMAND.UPDATE] = true, [COMMAND.PACKET] = true,
  [COMMAND.END_OF_TRANSFER] = true,
}

local function next_attempt(u)
  u.attempt = u.attempt + 1
  u.phase, u.current, u.restarted, u.early_complete, u.announced = nil, nil, false, false, false
  u.ends, u.packets = 0, {}
end

local function new_upgrade(number, now)
  local u = {number = number, attempt = 0, updates = 0, last_at = now, tool_at = now}
  next_attempt(u)
  return u
end

local function begins_another(u, item)
  if item.command == COMMAND.RESET then
    return u.completed or u.early_complete or item.at - u.last_at > T.next_upgrade_s
  end
  return item.command == COMMAND.UPDATE and u.completed
end

-- True while all goes well, so that no tool has a reason to start over.
local function is_undisturbed(u, now)
  local packet = u.current
  return u.phase == "transfer" and packet and packet.copies == 1 and packet.naks == 0
    and now - u.last_at < T.at_once_s and not u.restarted
end

local function gave_up(u, now)
  return u.updates > 0 and now - u.tool_at >= T.in_vain_s
end

local function intrude(u, item)
  item.foreign = item.title .. " while packet " .. (u.current and u.current.number or 0)
    .. " was in work: a second tool"
end

local function tool_packet(u, item)
  local number = little_endian(item.data:sub(2, 3))
  if u.phase ~= "transfer" or (u.restarted and number == 1) then
    if u.phase == "end" or u.phase == "confirm" or u.restarted then next_attempt(u) end
    u.phase = "transfer"
  end
  local packet = u.packets[number]
  if not packet then
    packet = {number = number, copies = 1, naks = 0}
    u.packets[number] = packet
  elseif u.current and u.current.number > number and packet.answered then
    intrude(u, item)
    return
  else
    packet.copies = packet.copies + 1
  end
  u.current = packet
  item.copy = packet.copies
  packet.item = item
end

local function tool_says(u, item)
  local command = item.command
  if command == COMMAND.PACKET then
    tool_packet(u, item)
  elseif command == COMMAND.RESET then
    local is_early = u.phase == nil or u.phase == "reset" or u.phase == "boot"
    if is_early and gave_up(u, item.begin_at) then next_attempt(u) end
    if is_early then
      u.phase = u.phase or "reset"
    elseif is_undisturbed(u, item.begin_at) then
      intrude(u, item)
    else
      next_attempt(u)
      u.phase = "reset"
    end
  elseif command == COMMAND.UPDATE then
    if is_undisturbed(u, item.begin_at) then
      intrude(u, item)
      return
    end
    local is_later = u.phase == "transfer" or u.phase == "end" or u.phase == "confirm"
    if is_later or (not u.announced and gave_up(u, item.begin_at)) then next_attempt(u) end
    u.updates, u.restarted, u.phase = u.updates + 1, false, "update"
  elseif command == COMMAND.END_OF_TRANSFER then
    u.ends = u.ends + 1
    if not u.completed then u.phase = "end" end
  elseif u.phase == "transfer" then
    intrude(u, item)
  elseif u.phase == "end" and command == COMMAND.READ_VERSION then
    u.phase = "confirm"
  end
end

local function device_says(u, item)
  local command = item.command
  if command == COMMAND.GENERAL_FEEDBACK then
    if u.phase == "reset" then u.phase = "boot" end
  elseif command == COMMAND.BOOT_VERSION then
    u.announced = true
    if u.phase == nil or u.phase == "reset" then
      u.phase = "boot"
    elseif u.phase == "transfer" and item.at - (u.request_at or 0) > T.leftover_boot_version_s then
      u.restarted = true
    end
  elseif command == COMMAND.REQUEST_TRANSFER then
    if u.phase == "transfer" and u.current then
      if u.current.number > 1 or u.current.answered then u.restarted = true end
    else
      u.request_at, u.phase = item.at, "transfer"
    end
  elseif command == COMMAND.ACK and u.phase == "transfer" then
    local packet = u.packets[little_endian(item.data)]
    if packet then packet.answered = true end
  elseif command == COMMAND.NAK and u.phase == "transfer" then
    local packet = u.current
    if packet and packet.number == little_endian(item.data) then packet.naks = packet.naks + 1 end
  elseif command == COMMAND.COMPLETE then
    if u.ends == 0 then u.early_complete = true else u.completed = true end
  end
end

-- State of the capture so far --------------------------------------------------------------------------

local G  -- everything that is known of this capture

function welling.init()
  G = {
    buses = {}, upgrades = 0,
    ids = {}, parts = {}, items = {}, cut_in = {},  -- by frame
  }
end

local function bus_of(interface)
  local bus = G.buses[interface]
  if not bus then
    bus = {now = -math.huge, streams = {}, holding = {}, upgrades = {}, asked = {}, cut_in = {}}
    G.buses[interface] = bus
  end
  return bus
end

-- Bits of a frame on the wire, as flasher.protocol.bittime counts them.

local BITS = T.bits

local function frame_bits(id, payload)
  local head = BITS.heads[id][#payload + 1]
  local state, inserted, crc = head[1], head[2], head[3]
  for at = 1, #payload do
    local byte = payload:byte(at)
    local index = state * 16 + shift(byte, 4) + 1
    inserted = inserted + BITS.inserted:byte(index)
    index = BITS.next_state:byte(index) * 16 + byte % 16 + 1
    inserted = inserted + BITS.inserted:byte(index)
    state = BITS.next_state:byte(index)
    crc = xor(crc * 256 % 32768, BITS.crc[xor(shift(crc, 7), byte) + 1])
  end
  local index = state * 8 + shift(crc, 12) + 1
  inserted, state = inserted + BITS.top_inserted:byte(index), BITS.top_next_state:byte(index)
  for _, part in ipairs({shift(crc, 8) % 16, shift(crc, 4) % 16, crc % 16}) do
    index = state * 16 + part + 1
    inserted, state = inserted + BITS.inserted:byte(index), BITS.next_state:byte(index)
  end
  return BITS.fixed[#payload + 1] + inserted + BITS.full_run:byte(state + 1)
end

-- When the last frame of a message had left the wire. Frames whose stamps lie closer together than
-- they can be on the wire bear the time at which an adapter accepted them.
local function left_at(item)
  local bitrate = T.dialects[welling.prefs.dialect].bitrate_bps
  if item.count == 0 then return item.end_at end  -- not the first that this frame has completed
  local frames = math.ceil(#item.wire / T.frame_data_size)
  local between = (frames - 1) * BITS.fixed[T.frame_data_size + 1] / bitrate
  if item.end_at - item.begin_at >= T.accepted_share * between then return item.end_at end
  local bits = 0
  for at = 1, #item.wire, T.frame_data_size do
    bits = bits + frame_bits(item.id, item.wire:sub(at, at + T.frame_data_size - 1))
  end
  return math.max(item.end_at, item.begin_at + bits / bitrate)
end

-- Requests and answers: one that is open is kept under what answers it.
local function answer_keys(item)
  local keys = {}
  for _, answer in ipairs(item.of.answers) do
    local key = (answer.id or IS_REQUEST[item.id]) * 65536 + answer.command
    if item.command == COMMAND.PACKET and item.of == ROWS[COMMAND.PACKET] then
      key = key .. "." .. little_endian(item.data:sub(2, 3))
    end
    keys[#keys + 1] = key
  end
  return keys
end

-- An application gives its command up after a time; a bootloader may be erasing.
local function is_open(request, item)
  return request.upgrade or item.at - request.at <= T.command_timeout_s
end

local function connect(bus, item)
  local asked = bus.asked
  local key = item.id * 65536 + item.command
  local numbered = item.of == ROWS[COMMAND.ACK] or item.of == ROWS[COMMAND.NAK]
  local request = numbered and asked[key .. "." .. little_endian(item.data)] or asked[key]
  if request and is_open(request, item) then
    item.answer_to = request.frame
    item.answer_ms = 1000 * math.max(0, item.at - left_at(request))
    request.answer_in = item.frame
    for _, each in ipairs(answer_keys(request)) do asked[each] = nil end
  end
  for _, each in ipairs(answer_keys(item)) do
    local before = asked[each]
    local is_same = before and before.id == item.id and before.command == item.command
    if is_same and is_open(before, item) and not item.copy then
      item.copy = (before.copy or 1) + 1
    end
    asked[each] = item
  end
end

local function follow(bus, item)
  local from_tool = IS_REQUEST[item.id] ~= nil
  local request_id = from_tool and item.id or IS_ANSWER[item.id]
  if not request_id then
    if item.kind == "message" then connect(bus, item) end
    return
  end
  local u = bus.upgrades[request_id]
  if from_tool and item.kind == "message" then
    if u and begins_another(u, item) then u = nil end
    if not u and BEGINS[item.command] then
      G.upgrades = G.upgrades + 1
      u = new_upgrade(G.upgrades, item.at)
    end
    bus.upgrades[request_id] = u
    if u then tool_says(u, item) end
  elseif u and not from_tool then
    if item.kind == "message" then device_says(u, item) end
  end
  if not from_tool then bus.cut_in[request_id] = nil end
  if u then
    item.upgrade, item.attempt, u.last_at = u.number, u.attempt, item.end_at
    if from_tool then u.tool_at = item.end_at end
  end
  if item.kind == "message" then connect(bus, item) end
end

-- A message that begins inside another one on the tool's id: two tools send.
local function is_cut_in(bus, id, payload, now)
  local state = bus.cut_in[id]
  if not state then
    state = {left = 0, at = now}
    bus.cut_in[id] = state
  end
  local found = false
  local is_head = #payload >= HEAD_SIZE and payload:sub(1, 2) == HEADER
    and T.modes[payload:byte(3)] and payload:byte(3) ~= REPORT
    and payload:byte(HEAD_SIZE) == payload:byte(T.prefix_size) - 2
  if is_head then
    found = state.left > 0 and now - state.at <= T.inter_frame_timeout_s
    state.left = T.overhead_size + payload:byte(T.prefix_size)
  end
  state.left, state.at = state.left - #payload, now
  return found
end

local function take(bus, s, found, frame, at)
  for _, item in ipairs(found) do
    local part = s.part or {begin = frame, begin_at = at, end_at = at, count = 0}
    s.part = nil
    part.done, part.item = frame, item
    item.frame, item.at, item.end_at = frame, at, part.end_at
    item.begin, item.begin_at, item.count = part.begin, part.begin_at, part.count
    if item.reason then
      item.kind, item.title = "damaged", T.titles.damaged
    else
      judge(item)
    end
    follow(bus, item)
  end
end

local function note_held(bus, s)
  local is_held = s.buffer ~= "" or s.junk ~= ""
  if is_held and not s.held then
    bus.holding[#bus.holding + 1] = s
  elseif s.held and not is_held then
    for at, each in ipairs(bus.holding) do
      if each == s then table.remove(bus.holding, at) break end
    end
  end
  s.held = is_held
end

-- What was cut short before `now`; returns the list of what it gave, nil for nothing.
local function drop_late(bus, frame, now)
  local items
  while true do
    local due
    for _, s in ipairs(bus.holding) do
      if s.due and (not due or s.due < due) then due = s.due end
    end
    if not due or due >= now then return items end
    local late = {}
    for _, s in ipairs(bus.holding) do
      if s.due and s.due <= due then late[#late + 1] = s end
    end
    items = items or {}
    for _, s in ipairs(late) do
      local found = {}
      cut_short(s, found)
      take(bus, s, found, frame, due)
      note_held(bus, s)
      for _, item in ipairs(found) do items[#items + 1] = item end
    end
  end
end

local function receive(key, interface, id, payload, frame, at)
  local bus = bus_of(interface)
  local now = math.max(bus.now, at)
  bus.now = now
  local items = drop_late(bus, frame, now)
  local s = bus.streams[id]
  if not s then
    s = {id = id, buffer = "", junk = "", needed = 2}
    bus.streams[id] = s
  end
  local part = s.part
  if not part then
    part = {begin = frame, begin_at = now, count = 0}
    s.part = part
  end
  part.count, part.end_at = part.count + 1, now
  s.buffer = s.buffer .. payload
  s.due = now + T.inter_frame_timeout_s
  if #s.buffer >= s.needed then
    local found = {}
    scan(s, found)
    if s.buffer == "" and s.junk == "" then s.due = nil end
    if #found > 0 then
      take(bus, s, found, frame, now)
      items = items or {}
      for _, item in ipairs(found) do items[#items + 1] = item end
    end
  end
  note_held(bus, s)
  if IS_REQUEST[id] and is_cut_in(bus, id, payload, now) then G.cut_in[key] = true end
  G.parts[key], G.items[key] = part, items
end

-- Showing ---------------------------------------------------------------------------------------------

local INFO_MAX = 100

local ESCAPES = {["\n"] = "\\n", ["\r"] = "\\r", ["\t"] = "\\t"}

local function printable(raw)
  return (raw:gsub("[^\032-\126]", function(char)
    return ESCAPES[char] or string.format("\\x%02x", char:byte())
  end))
end

local function decode_text(raw)
  local stop = raw:find(".", 1, true)
  local text = raw
  if stop and not raw:find("[^ ]", stop + 1) then text = raw:sub(1, stop - 1) end
  return (printable(text):gsub("%s+$", ""))
end

local function signed(value, size)
  local half = 2 ^ (8 * size - 1)
  return value >= half and value - 2 * half or value
end

-- Adds one field and returns its value as the packet list shows it.
local SHOW = {}

function SHOW.number(tree, f, range, raw)
  local value = little_endian(raw)
  if f.signed then value = signed(value, f.size) end
  value = value - f.offset
  local node
  if f.offset ~= 0 then
    node = tree:add(F[f.filter], range, value)
  else
    node = tree:add_le(F[f.filter], range)
  end
  local remark = value == 0 and f.if_zero or value > 100 and f.if_above_100 or ""
  if remark ~= "" then node:append_text(" (" .. remark .. ")") end
  return string.format("%d", value)
end

function SHOW.address(tree, f, range, raw)
  tree:add_le(F[f.filter], range)
  return string.format("0x%08X", little_endian(raw))
end

function SHOW.numbers(tree, f, range, raw)
  local values, used = {}, 0
  for at = 0, f.size - 1, f.each do
    tree:add_le(F[f.filter], range(at, f.each))
      :prepend_text(string.format("[%d] ", at / f.each + 1))
    values[#values + 1] = little_endian(raw:sub(at + 1, at + f.each))
    if values[#values] ~= 0 then used = #values end
  end
  return used == 0 and "none" or table.concat(values, " ", 1, used)
end

function SHOW.flags(tree, f, range, raw)
  local node = tree:add_le(F[f.filter], range)
  local value, set = little_endian(raw), {}
  for _, bit in ipairs(f.bits) do
    node:add_le(F[f.filter .. "." .. bit.name], range)
    if math.floor(value / bit.mask) % 2 == 1 then set[#set + 1] = bit.text end
  end
  local text = #set > 0 and table.concat(set, ", ") or f.none
  node:append_text(" (" .. text .. ")")
  return text
end

function SHOW.text(tree, f, range, raw)
  local text = decode_text(raw)
  tree:add(F[f.filter], range, text)
  return text
end

function SHOW.latin(tree, f, range, raw)
  local text = printable(raw)
  tree:add(F[f.filter], range, text)
  return text
end

function SHOW.constant(tree, f, range, raw)
  if f.must_be then return end  -- says nothing: it has been checked
  local text = printable(raw)
  local node = tree:add(F[f.filter], range, text)
  if raw ~= f.expected then
    node:append_text(" (not " .. printable(f.expected) .. ")")
    return text
  end
end

function SHOW.reserved(tree, f, range, raw)
  if raw:find("[^%z]") then tree:add(F[f.filter], range) end
end

function SHOW.bytes(tree, f, range, raw)
  tree:add(F[f.filter], range)
end

local function show_fields(item, tree, tvb)
  local at, texts = 0, {}
  for _, f in ipairs(item.of.fields) do
    local raw = item.data:sub(at + 1, at + f.size)
    local text = SHOW[f.kind](tree, f, tvb(HEAD_SIZE + at, f.size), raw)
    if text then
      texts[#texts + 1] = f.label .. " " .. text .. (f.unit ~= "" and " " .. f.unit or "")
    end
    at = at + f.size
  end
  return table.concat(texts, ", ")
end

local function show_crc(item, tree, tvb)
  local size = #item.wire
  local is_wrong = item.reason == REASON.BAD_CRC
  tree:add(F.crc, tvb(size - 5, 4))
  if is_wrong then
    tree:add(F["crc.expected"], tvb(size - 5, 4), computed_crc(item.id, item.wire))
  end
  tree:add(F["crc.ok"], tvb(size - 5, 4), not is_wrong)
end

local function generated(tree, field, value)
  return tree:add(field, value):set_generated()
end

-- What is known of the surroundings of a message: its frames, its upgrade, its answer.
local function show_context(item, tree)
  generated(tree, F.begin, item.begin)
  generated(tree, F.frames, item.count)
  if item.upgrade then
    generated(tree, F.upgrade, item.upgrade)
    generated(tree, F.attempt, item.attempt)
  end
  if item.copy then generated(tree, F.copy, item.copy) end
  if item.answer_to then
    generated(tree, F.answer_to, item.answer_to)
    generated(tree, F.answer_ms, item.answer_ms):append_text(" ms")
  end
  if item.answer_in then generated(tree, F.answer_in, item.answer_in) end
end

local function show_item(item, parent, tvb)
  local node = parent:add(welling, tvb(), "Welling: " .. item.title)
  generated(node, F.kind, item.kind)
  generated(node, F.message, item.title)
  local route = T.ids[item.id]
  generated(node, F.sender, route.sender)
  generated(node, F.receiver, route.receiver)
  local info = item.title
  if item.reason then
    local text = T.reason_texts[item.reason]
    node:add(F.damage, tvb(), item.reason):append_text(" (" .. text .. ")")
    node:add(F["damage.bytes"], tvb())
    if item.reason == REASON.BAD_CRC then
      show_crc(item, node, tvb)
      node:add_proto_expert_info(E.crc)
    else
      node:add_proto_expert_info(E.damaged, text)
    end
    info = info .. ": " .. text
  else
    node:add(F.mode, tvb(2, 1))
    node:add(F.length, tvb(3, 1))
    node:add(F.command, tvb(4, 2))
    if item.of and item.kind == "message" then
      local text = show_fields(item, node, tvb)
      local number = item.of == ROWS[COMMAND.PACKET] and " of " or nil
      if number then
        text = little_endian(item.data:sub(2, 3)) .. number .. little_endian(item.data:sub(4, 5))
      elseif item.of == ROWS[COMMAND.ACK] or item.of == ROWS[COMMAND.NAK] then
        text = tostring(little_endian(item.data))
      end
      if text ~= "" then info = info .. " " .. text end
    elseif #item.data > 0 then
      node:add(F.data, tvb(HEAD_SIZE, #item.data))
    end
    show_crc(item, node, tvb)
    generated(node, F.in_dialect, is_in_dialect(item))
    if item.problem then
      generated(node, F.problem, item.problem)
      node:add_proto_expert_info(E.malformed, item.problem)
      info = info .. ": " .. item.problem
    elseif item.kind == "unknown" then
      node:add_proto_expert_info(E.unknown)
      info = string.format("%s: command %04X", info, item.command)
    end
    if not is_in_dialect(item) then node:add_proto_expert_info(E.dialect) end
  end
  if #info > INFO_MAX then info = info:sub(1, INFO_MAX) .. " ..." end
  show_context(item, node)
  if item.copy and item.copy > 1 then
    node:add_proto_expert_info(E.repeated, "Sent for the time " .. item.copy)
    info = info .. " (sent for the time " .. item.copy .. ")"
  end
  if item.kind == "message" and item.of == ROWS[COMMAND.NAK] then
    node:add_proto_expert_info(E.nak)
  end
  if item.is_alarm then node:add_proto_expert_info(E.faults) end
  if item.foreign then node:add_proto_expert_info(E.foreign_tool, item.foreign) end
  if item.answer_ms then info = string.format("%s, after %.2f ms", info, item.answer_ms) end
  return info
end

local function show_part(part, tree, tvb, frame)
  local node = tree:add(welling, tvb(), "Welling: part of a message")
  generated(node, F.part, true)
  generated(node, F.begin, part.begin)
  if not part.done then return "part of a message" end
  generated(node, F["end"], part.done)
  return string.format("part of: %s (frame %d)", part.item.title, part.done)
end

-- The dissector ---------------------------------------------------------------------------------------

local interface_of = Field.new("frame.interface_id")

function welling.dissector(tvb, pinfo, tree)
  local size = tvb:reported_len()
  if size == 0 or size > T.frame_data_size or tvb:captured_len() < size then return 0 end
  local id = pinfo.match_uint
  local frame = pinfo.number
  -- Numbers from 1 on make an array, which is much faster than any other table. Only a protocol that
  -- carries CAN may have more than one CAN frame in a packet.
  G.ids[frame] = G.ids[frame] or id
  local key = G.ids[frame] == id and frame or frame .. "." .. id
  if not pinfo.visited then
    local interface = interface_of()
    receive(key, interface and interface.value or 0, id, tvb:raw(0, size), frame, pinfo.abs_ts)
  end
  local items, part = G.items[key], G.parts[key]
  local route = T.ids[id]
  pinfo.cols.protocol = "Welling"
  pinfo.cols.src = route.sender
  pinfo.cols.dst = route.receiver
  local texts = {}
  for _, item in ipairs(items or {}) do
    texts[#texts + 1] = show_item(item, tree, ByteArray.new(item.wire, true):tvb("Message"))
  end
  if part and part.done ~= frame then texts[#texts + 1] = show_part(part, tree, tvb, frame) end
  if G.cut_in[key] then
    local text = "A message begins inside another one on the tool's id: a second tool"
    tree:add_proto_expert_info(E.foreign_tool, text)
    texts[#texts + 1] = text
  end
  pinfo.cols.info = table.concat(texts, "; ")
  return size
end

local table_of_ids = DissectorTable.get("can.id")
for id in pairs(T.ids) do
  table_of_ids:add(id, welling)
end
