-- Messages to webhooks: who delivers which, and what came of it. Each step is atomic.
--
-- KEYS[1]  prefix of all keys ("smsr")
-- ARGV[1]  name of the step, then its own arguments
--
-- Keys, all under the prefix:
--   webhooks           sorted set of message ids by the time of their next attempt; while an attempt
--                      is made, by the time at which it counts as lost
--   webhook:{message}  hash: the record of the job as it was when it ended (`transitions.lua`
--                      writes it in the step that ends the job), with the job's id as `of_job` and
--                      the number of attempts as `attempts`
--
-- The number of attempts is a fencing token: only who began the last one may say how it ended.

redis.replicate_commands() -- Redis 6 needs it to write after TIME; later ones do it anyway

local prefix, step = KEYS[1] .. ':', ARGV[1]
local outbox, counters = prefix .. 'webhooks', prefix .. 'counters'
local looked_at, put_off_seconds = 1000, 5

local time = redis.call('TIME')
local now = tonumber(time[1]) + tonumber(time[2]) / 1e6

local function stamp(seconds)
  return string.format('%.6f', seconds)
end

local function count(name)
  redis.call('HINCRBY', counters, 'webhook:' .. name, 1)
end

-- Shows in the record of the job how its message stands, where there is one that still knows of it.
local function show(message, job, ...)
  local key = prefix .. 'job:' .. job
  if redis.call('HGET', key, 'webhook_message') == message then
    redis.call('HSET', key, ...)
    local version = redis.call('HINCRBY', key, 'version', 1)
    local owner = redis.call('HGET', key, 'owner') or ''
    redis.call('PUBLISH', prefix .. 'changed:' .. job, version .. ' ' .. owner)
  end
end

local steps = {}

-- lease seconds, most messages, most of a host, how many of each host the caller has (JSON)
-- -> {{message, attempt, fields and values of the snapshot}, ...}
-- Messages of hosts that have enough are passed over. Where so many of them are due that others
-- might never be looked at, they are put off.
function steps.claim(lease, most, each, busy)
  local claimed, passed = {}, {}
  busy = cjson.decode(busy)
  local due = redis.call('ZRANGEBYSCORE', outbox, '-inf', stamp(now), 'LIMIT', 0, looked_at)
  for _, message in ipairs(due) do
    local key = prefix .. 'webhook:' .. message
    local url = redis.call('HGET', key, 'webhook')
    local host = url and url:match('^%a+://([^/?#]*)'):lower()
    if #claimed == tonumber(most) then
      break
    elseif not url then
      redis.call('ZREM', outbox, message)
    elseif (busy[host] or 0) >= tonumber(each) then
      passed[#passed + 1] = message
    else
      busy[host] = (busy[host] or 0) + 1
      redis.call('ZADD', outbox, stamp(now + lease), message)
      local attempt = redis.call('HINCRBY', key, 'attempts', 1)
      claimed[#claimed + 1] = { message, attempt, redis.call('HGETALL', key) }
    end
  end
  if #due == looked_at then
    for _, message in ipairs(passed) do
      redis.call('ZADD', outbox, stamp(now + put_off_seconds), message)
    end
  end
  return claimed
end

-- message, attempt, 'delivered' | 'failed' | 'given_up', seconds until the next attempt, HTTP status
-- or '', error or '' -> 'ok' | 'lost'
function steps.settle(message, attempt, outcome, pause, status, failure)
  local key = prefix .. 'webhook:' .. message
  local job, current = unpack(redis.call('HMGET', key, 'of_job', 'attempts'))
  if current ~= attempt then
    return 'lost'
  end
  count(outcome)
  local state = { attempts = tonumber(attempt), state = outcome }
  if outcome == 'failed' then
    redis.call('ZADD', outbox, stamp(now + pause), message)
    state.state, state.next_attempt_at = 'pending', stamp(now + pause)
  else
    redis.call('ZREM', outbox, message)
    redis.call('DEL', key)
  end
  if outcome == 'delivered' then
    state.delivered_at = stamp(now)
  end
  if status ~= '' then
    state.status = tonumber(status)
  end
  if failure ~= '' then
    state.error = failure
  end
  show(message, job, 'webhook_state', cjson.encode(state))
  return 'ok'
end

return steps[step](unpack(ARGV, 2))
