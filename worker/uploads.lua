-- The life of an upload: every change of its record is one atomic step here.
--
-- KEYS[1]  prefix of all keys ("smsr")
-- ARGV[1]  name of the step, ARGV[2] owner ('' for none), ARGV[3] id, then the step's own arguments
--
-- Keys, all under the prefix:
--   upload:{owner}:{id}          hash: the record, which Redis removes at the end of its time to live
--   upload:{owner}:{id}:parts    list of the objects that hold the bytes, where there are several
--   uploads@{owner}              sorted set of ids by time of creation; it lives as long as the record
--                                that lives longest, and new uploads push out those that are over
--   incoming                     sorted set of storage folders by the time they are to be removed;
--                                a folder stands here before the first byte is written to it
--   job:{id}                     read only: whether a job that took an upload exists
--
-- `token` is a fencing token: it grows with every request that writes, and only the holder of the
-- current one may move the offset. A folder belongs to one upload and one upload only. Every step
-- may be sent twice with the effect of once.

redis.replicate_commands() -- Redis 6 needs it to write after TIME; later ones do it anyway

local prefix, step, owner, id = KEYS[1] .. ':', ARGV[1], ARGV[2], ARGV[3]
local incoming, index = prefix .. 'incoming', prefix .. 'uploads@' .. owner

local time = redis.call('TIME')
local now = tonumber(time[1]) + tonumber(time[2]) / 1e6

local function stamp(seconds)
  return string.format('%.6f', seconds)
end

local function key_of(upload)
  return prefix .. 'upload:' .. owner .. ':' .. upload
end

local record = key_of(id)
local parts = record .. ':parts'

local function read(field, key)
  return redis.call('HGET', key or record, field) or nil
end

-- Has the index live for so long at least.
local function keep_index(milliseconds)
  if redis.call('PTTL', index) < milliseconds then
    redis.call('PEXPIRE', index, milliseconds)
  end
end

-- Puts an upload into the index, and takes out some of the oldest whose time was over.
local function enlist(upload, created)
  for _, old in ipairs(redis.call('ZRANGE', index, 0, 9)) do
    if redis.call('EXISTS', key_of(old)) == 0 then
      redis.call('ZREM', index, old)
    end
  end
  redis.call('ZADD', index, created, upload)
  keep_index(redis.call('PTTL', key_of(upload)))
end

-- Keeps a record and its folder for another while.
local function extend(ttl)
  local milliseconds = math.ceil(tonumber(ttl) * 1000)
  redis.call('HSET', record, 'expires_at', stamp(now + tonumber(ttl)))
  redis.call('PEXPIRE', record, milliseconds)
  redis.call('PEXPIRE', parts, milliseconds)
  keep_index(milliseconds)
  redis.call('ZADD', incoming, stamp(now + tonumber(ttl)), read('folder'))
end

-- Whether a job took an upload. One that took it a while ago and never came to be did not.
local function taken(key, patience)
  local job = read('job', key)
  if not job then
    return false
  end
  return redis.call('EXISTS', prefix .. 'job:' .. job) == 1
    or now - tonumber(read('taken_at', key)) < tonumber(patience)
end

local steps = {}

-- ttl, folder -> nil; before anything is written to a folder that has no record yet
function steps.reserve(ttl, folder)
  redis.call('ZADD', incoming, stamp(now + tonumber(ttl)), folder)
end

-- ttl, folder, field, value, ... -> 'ok' | 'exists'
function steps.create(ttl, folder, ...)
  if redis.call('EXISTS', record) == 1 then
    return read('folder') == folder and 'ok' or 'exists'
  end
  redis.call('HSET', record, 'folder', folder, 'created_at', stamp(now), 'offset', 0, 'token', 0,
    ...)
  extend(ttl)
  enlist(id, stamp(now))
  return 'ok'
end

-- ttl, folder, field, value, ... -> {'created' | 'replaced' | 'used', former folder}
-- A whole file takes the place of what the upload was.
function steps.replace(ttl, folder, ...)
  local former = read('folder')
  if former and read('job') then
    return { 'used', '' }
  end
  if former == folder then
    return { 'created', '' }
  end
  local token, created = read('token') or 0, read('created_at') or stamp(now)
  redis.call('DEL', record, parts)
  redis.call('HSET', record, 'folder', folder, 'created_at', created, 'token', token + 1, ...)
  extend(ttl)
  enlist(id, created)
  if former then
    redis.call('ZADD', incoming, stamp(now), former)
  end
  return { former and 'replaced' or 'created', former or '' }
end

-- ttl, offset -> {'ok', token} | {'gone'} | {'offset'} | {'used'}
function steps.begin(ttl, offset)
  if redis.call('EXISTS', record) == 0 then
    return { 'gone' }
  end
  if read('job') then
    return { 'used' }
  end
  if read('offset') ~= offset then
    return { 'offset' }
  end
  extend(ttl)
  return { 'ok', redis.call('HINCRBY', record, 'token', 1) }
end

-- token -> 1 | 0
function steps.holds(token)
  return read('token') == token and 1 or 0
end

-- token, ttl, from, to, part, ... -> 'ok' | 'lost'
function steps.commit(token, ttl, from, to, ...)
  if read('token') ~= token then
    return 'lost'
  end
  local offset = read('offset')
  if offset == from and from ~= to then
    redis.call('HSET', record, 'offset', to)
    if select('#', ...) > 0 then
      redis.call('RPUSH', parts, ...)
    end
  elseif offset ~= to then
    return 'lost'
  end
  extend(ttl)
  return 'ok'
end

-- token, offset -> 'ok' | 'lost'; the storage turned out to hold less than the record says
function steps.rewind(token, offset)
  if read('token') ~= token then
    return 'lost'
  end
  redis.call('HSET', record, 'offset', offset)
  return 'ok'
end

-- token, key, sha256 -> 'ok' | 'lost'; all bytes are there, as one object
function steps.seal(token, key, sha256)
  if read('token') ~= token or read('offset') ~= read('length') then
    return 'lost'
  end
  redis.call('HSET', record, 'key', key, 'sha256', sha256)
  return 'ok'
end

-- seconds until the folder is looked at again -> folder | nil
function steps.delete(again)
  local folder = read('folder')
  if not folder then
    return nil
  end
  redis.call('DEL', record, parts)
  redis.call('ZREM', index, id)
  redis.call('ZADD', incoming, stamp(now + tonumber(again)), folder)
  return folder
end

-- id is '*'; job, patience, seconds to keep the folders, id, role, id, role, ...
-- -> {'ok'} | {'gone' | 'unfinished' | 'used', id}
function steps.take(job, patience, keep, ...)
  local wanted = { ... }
  for i = 1, #wanted, 2 do
    local upload, key = wanted[i], key_of(wanted[i])
    if redis.call('EXISTS', key) == 0 then
      return { 'gone', upload }
    elseif not read('sha256', key) then
      return { 'unfinished', upload }
    elseif read('job', key) ~= job and taken(key, patience) then
      return { 'used', upload }
    end
  end
  for i = 1, #wanted, 2 do
    local upload, key = wanted[i], key_of(wanted[i])
    local former = read('job', key)
    if former and former ~= job then
      redis.call('HSET', key, 'former_place', former .. '/' .. read('taken_as', key))
    end
    redis.call('HSET', key, 'job', job, 'taken_as', wanted[i + 1], 'taken_at', stamp(now))
    redis.call('ZADD', incoming, stamp(now + tonumber(keep)), read('folder', key))
    redis.call('ZREM', index, upload)
  end
  return { 'ok' }
end

-- id is '*'; job, ids ... -> nil; the job will not be, and its files are where they were put
function steps.give_back(job, ...)
  for _, upload in ipairs({ ... }) do
    local key = key_of(upload)
    if read('job', key) == job then
      redis.call('HSET', key, 'former_place', job .. '/' .. read('taken_as', key))
      redis.call('HDEL', key, 'job', 'taken_as', 'taken_at')
      enlist(upload, read('created_at', key))
      redis.call('ZADD', incoming, read('expires_at', key), read('folder', key))
    end
  end
end

return steps[step](unpack(ARGV, 4))
