-- The life of a job: every change of its record is one atomic step here.
--
-- KEYS[1]  prefix of all keys ("smsr")
-- ARGV[1]  name of the step, ARGV[2] job id, then the step's own arguments
--
-- Keys, all under the prefix:
--   job:{id}                     hash: the record (documents inside it are JSON text)
--   jobs, jobs:{status}          sorted sets of ids by time of creation
--   jobs@{owner}[:{status}]      the same for the jobs of one owner
--   jobs[@{owner}]#{batch}[:{status}]  the same for the jobs of one batch
--   jobs:queued:{priority}       the same for the queued jobs of one priority
--   batches[@{owner}]            sorted set of the labels of batches by their latest job's creation
--   e3d, seconds, ended[@{owner}]#{batch}  sorted sets of the jobs of a batch by the error and run
--                                time of those that succeeded and by the end of all that have ended
--   equal:{digest}               sorted set of the succeeded jobs of one digest by their end
--   holders:{result prefix}      set of the jobs whose result this is, once another job took it over
--   idempotency:{name}           hash: the job that claims a key, and the fingerprint of its
--                                submission once there is such a job
--   leases                       sorted set of running ids by the end of their lease
--   expiry                       sorted set of finished ids by the end of their time to live
--   garbage                      sorted set of storage prefixes by the time they are to be removed
--   stored                       hash: bytes that each owner's jobs and holds take
--   hold:{id}                    hash: owner and bytes of an upload under way
--   holds                        sorted set of ids of holds by the time they lapse
--   counters                     hash: counts of all jobs (`worker.counters`, which also gives the
--                                `bounds` of histograms and the `sizes` of jobs used here)
--   webhooks, webhook:{message}  messages about ends of jobs (`outbox.lua`)
--   changed:{id}                 channel: the record's version at every visible change, or
--                                'deleted'; a space; the owner
--
-- `attempt` is a fencing token: it grows with every start of the job, and only the holder of the
-- current one, while the job is running, may report, publish or fail. Every step may be sent twice
-- (a client repeats it when the connection broke before the answer came) with the effect of once.

redis.replicate_commands() -- Redis 6 needs it to write after TIME; later ones do it anyway

local prefix, step, id = KEYS[1] .. ':', ARGV[1], ARGV[2]
local record = prefix .. 'job:' .. id
local leases, expiry, garbage = prefix .. 'leases', prefix .. 'expiry', prefix .. 'garbage'
local counters = prefix .. 'counters'
local stored, holds = prefix .. 'stored', prefix .. 'holds'

local time = redis.call('TIME')
local now = tonumber(time[1]) + tonumber(time[2]) / 1e6

local function stamp(seconds)
  return string.format('%.6f', seconds)
end

local function read(key, field)
  return redis.call('HGET', key, field) or nil
end

local function changed(job)
  local key = prefix .. 'job:' .. job
  local version = redis.call('HINCRBY', key, 'version', 1)
  redis.call('PUBLISH', prefix .. 'changed:' .. job, version .. ' ' .. (read(key, 'owner') or ''))
end

-- Endings of the names of keys that exist for all jobs and for those of an owner.
local function scopes(owner)
  return (owner and owner ~= '') and { '', '@' .. owner } or { '' }
end

-- The indices in which a job stands for a status, or for having any ('').
local function indices(key, status)
  local owner, batch, priority = unpack(redis.call('HMGET', key, 'owner', 'batch', 'priority'))
  local names = {}
  for _, scope in ipairs(scopes(owner)) do
    names[#names + 1] = prefix .. 'jobs' .. scope .. status
    if batch then
      names[#names + 1] = prefix .. 'jobs' .. scope .. '#' .. batch .. status
    end
  end
  if status == ':queued' then
    names[#names + 1] = prefix .. 'jobs:queued:' .. (priority or 'normal')
  end
  return names
end

local function enter(job, status)
  local key = prefix .. 'job:' .. job
  local created = read(key, 'created_at')
  for _, index in ipairs(indices(key, status)) do
    redis.call('ZADD', index, created, job)
  end
end

local function leave(job, status)
  for _, index in ipairs(indices(prefix .. 'job:' .. job, status)) do
    redis.call('ZREM', index, job)
  end
end

local function set_status(job, to)
  local key = prefix .. 'job:' .. job
  leave(job, ':' .. read(key, 'status'))
  enter(job, ':' .. to)
  redis.call('HSET', key, 'status', to)
end

-- Notes a number of a job for the summary of its batch; nil takes it out.
local function tally(job, name, value)
  local owner, batch = unpack(redis.call('HMGET', prefix .. 'job:' .. job, 'owner', 'batch'))
  if batch then
    for _, scope in ipairs(scopes(owner)) do
      local key = prefix .. name .. scope .. '#' .. batch
      if value then
        redis.call('ZADD', key, value, job)
      else
        redis.call('ZREM', key, job)
      end
    end
  end
end

-- Adds to what an owner stores; jobs and uploads without an owner are not counted.
local function add_stored(owner, bytes)
  if owner and owner ~= '' and bytes ~= 0 then
    if redis.call('HINCRBY', stored, owner, bytes) == 0 then
      redis.call('HDEL', stored, owner)
    end
  end
end

-- Sets what the inputs or the result of a job take ('input_bytes', 'result_bytes'). The record
-- says what its owner was charged, so that exactly this is taken off again.
local function charge(job, what, bytes)
  local key = prefix .. 'job:' .. job
  add_stored(read(key, 'owner'), bytes - (tonumber(read(key, what)) or 0))
  redis.call('HSET', key, what, bytes)
end

local function drop_hold(upload)
  local key = prefix .. 'hold:' .. upload
  local owner, bytes = unpack(redis.call('HMGET', key, 'owner', 'bytes'))
  if owner then
    add_stored(owner, -bytes)
    redis.call('DEL', key)
    redis.call('ZREM', holds, upload)
  end
end

-- Whether an owner stores as much as the limit (nil for none) or more, once some bytes are added.
local function too_much(owner, bytes, limit)
  return limit and owner ~= '' and bytes > 0
    and (tonumber(redis.call('HGET', stored, owner)) or 0) + bytes > tonumber(limit)
end

-- Whether an owner has as many queued and running jobs as the limit (nil for none) or more.
local function too_many(owner, limit)
  return limit and owner ~= ''
    and redis.call('ZCARD', prefix .. 'jobs@' .. owner .. ':queued')
      + redis.call('ZCARD', prefix .. 'jobs@' .. owner .. ':running') >= tonumber(limit)
end

local function held(result)
  return redis.call('EXISTS', prefix .. 'holders:' .. result) == 1
end

-- Puts the results of attempts on the list of garbage, but for one that other jobs hold.
local function discard_results(job, first, last)
  for attempt = first, last do
    local result = 'results/' .. job .. '/' .. attempt .. '/'
    if not held(result) then
      redis.call('ZADD', garbage, stamp(now), result)
    end
  end
end

-- Takes back what the end of a job has said: its numbers, and its result, which becomes garbage
-- when no other job holds it.
local function reopen(job)
  local key = prefix .. 'job:' .. job
  local result, digest = unpack(redis.call('HMGET', key, 'result_prefix', 'digest'))
  for _, name in ipairs({ 'e3d', 'seconds', 'ended' }) do
    tally(job, name, nil)
  end
  if digest then
    redis.call('ZREM', prefix .. 'equal:' .. digest, job)
  end
  if result then
    redis.call('SREM', prefix .. 'holders:' .. result, job)
    if not held(result) then
      redis.call('ZADD', garbage, stamp(now), result)
    end
  end
  redis.call('ZREM', expiry, job)
end

local function count(name)
  redis.call('HINCRBY', counters, name, 1)
end

-- Counts seconds into the histogram of a name.
local function observe(name, seconds)
  seconds = math.max(0, seconds)
  local bucket = 'inf'
  for _, bound in ipairs(bounds) do
    if seconds <= tonumber(bound) then
      bucket = bound
      break
    end
  end
  count(name .. ':' .. bucket)
  redis.call('HINCRBYFLOAT', counters, name .. ':sum', stamp(seconds))
end

local function size_of(key)
  local frames, points = unpack(redis.call('HMGET', key, 'frames', 'points'))
  if frames and points then
    for _, size in ipairs(sizes) do
      if frames * points < size[2] then
        return size[1]
      end
    end
  end
  return 'unknown'
end

-- Puts the news of a job that has ended into the outbox, with the record as it is now.
local function notify(job)
  local key = prefix .. 'job:' .. job
  if read(key, 'webhook') then
    local message = 'msg_' .. job .. '_' .. redis.call('HINCRBY', key, 'webhook_count', 1)
    redis.call('HSET', key, 'webhook_message', message)
    redis.call('HDEL', key, 'webhook_state')
    redis.call('COPY', key, prefix .. 'webhook:' .. message)
    redis.call('HSET', prefix .. 'webhook:' .. message, 'of_job', job, 'attempts', 0)
    redis.call('ZADD', prefix .. 'webhooks', stamp(now), message)
  end
end

-- Sets the end of the time to live of a job that has ended; 0 seconds keep it for ever.
local function expire(job, finished, ttl)
  local key = prefix .. 'job:' .. job
  if ttl > 0 then
    redis.call('HSET', key, 'expires_at', stamp(finished + ttl))
    redis.call('ZADD', expiry, stamp(finished + ttl), job)
  else
    redis.call('HDEL', key, 'expires_at')
    redis.call('ZREM', expiry, job)
  end
end

-- Ends a job, without counting it. The time to live is the job's own or the one given; 0 keeps it
-- for ever.
local function close(job, status, ttl)
  local key = prefix .. 'job:' .. job
  local own, digest, e3d = unpack(redis.call('HMGET', key, 'ttl', 'digest', 'e3d'))
  ttl = tonumber(own or ttl)
  redis.call('ZREM', leases, job)
  redis.call('HDEL', key, 'worker', 'suspected_at', 'cancel_requested_at')
  redis.call('HSET', key, 'finished_at', stamp(now))
  expire(job, now, ttl)
  tally(job, 'ended', stamp(now))
  if status == 'succeeded' then
    tally(job, 'e3d', e3d or nil)
    if digest then
      redis.call('ZADD', prefix .. 'equal:' .. digest, stamp(now), job)
    end
  end
  set_status(job, status)
  changed(job)
  notify(job)
end

-- Ends a job that was to be run.
local function finish(job, status, ttl)
  local key = prefix .. 'job:' .. job
  count('ended:' .. status)
  if read(key, 'status') == 'running' then
    local seconds = now - read(key, 'started_at')
    observe('run:' .. size_of(key), seconds)
    if status == 'succeeded' then
      tally(job, 'seconds', stamp(seconds))
    end
  end
  close(job, status, ttl)
end

local function fail(job, problem, slug, ttl)
  redis.call('HSET', prefix .. 'job:' .. job, 'problem', problem)
  count('failed:' .. slug)
  finish(job, 'failed', ttl)
end

-- Takes a running job from its worker: queued again, or ended where it was cancelled or lost too
-- often. Returns what became of it.
local function take_back(job, counts, max_attempts, problem, slug, ttl)
  local key = prefix .. 'job:' .. job
  local attempt = tonumber(read(key, 'attempt'))
  discard_results(job, attempt, attempt)
  if read(key, 'cancel_requested_at') then
    redis.call('HDEL', key, 'progress')
    finish(job, 'cancelled', ttl)
    return 'cancelled'
  end
  local lost = redis.call('HINCRBY', key, 'lost_attempts', counts)
  redis.call('HINCRBY', counters, 'lost', counts)
  if lost >= tonumber(max_attempts) then
    fail(job, problem, slug, ttl)
    return 'failed'
  end
  redis.call('ZREM', leases, job)
  redis.call('HDEL', key, 'worker', 'suspected_at', 'progress')
  redis.call('HSET', key, 'queued_at', stamp(now))
  set_status(job, 'queued')
  changed(job)
  return 'queued'
end

-- Whether an attempt may still act: 'ok', 'cancelled', 'lost' or 'gone'.
local function verdict(attempt)
  local status = read(record, 'status')
  if not status then
    return 'gone'
  end
  if status ~= 'running' or read(record, 'attempt') ~= attempt then
    return 'lost'
  end
  if read(record, 'cancel_requested_at') then
    return 'cancelled'
  end
  return 'ok'
end

local function renew(seconds)
  redis.call('ZADD', leases, 'XX', stamp(now + seconds), id)
  redis.call('HDEL', record, 'suspected_at')
end

local steps = {}

-- Returns the latest job of a digest that will not be removed for being too old.
local function equal(digest)
  for _, job in ipairs(redis.call('ZREVRANGE', prefix .. 'equal:' .. digest, 0, 9)) do
    local due = redis.call('ZSCORE', expiry, job)
    if not due or tonumber(due) > now then
      return job
    end
  end
  return nil
end

-- Makes the result of a job that of this one, too, which thereby has succeeded.
local function take_over(job, ttl)
  local key = prefix .. 'job:' .. job
  redis.call('SADD', prefix .. 'holders:' .. read(key, 'result_prefix'), job, id)
  for _, field in ipairs({ 'result_prefix', 'frames', 'points', 'metrics', 'e3d', 'progress' }) do
    local value = read(key, field)
    if value then
      redis.call('HSET', record, field, value)
    end
  end
  redis.call('HSET', record, 'reused_from', read(key, 'reused_from') or job,
    'timings', '{"queued":0.0,"total":0.0}')
  charge(id, 'result_bytes', tonumber(read(key, 'result_bytes') or 0))
  count('reused')
  close(id, 'succeeded', ttl)
end

-- Whether a key of idempotency is another job's, or the job's own already.
local function taken(key)
  local job, fingerprint = unpack(redis.call('HMGET', key, 'job', 'fingerprint'))
  return fingerprint or (job and job ~= id)
end

-- owner, nonce, terms (JSON), then field, value, ... -> 'ok' | 'exists' | 'taken' | 'busy' | 'full'
-- The terms: most_jobs and most_bytes that the owner may have (absent for any), bytes of the inputs,
-- ids of the uploads whose holds end as this job begins, whether it may reuse the result of an equal
-- job, its ttl then, and a key of idempotency (name, fingerprint, seconds to keep it), or none.
function steps.create(owner, nonce, terms, ...)
  local known = read(record, 'nonce')
  if known then
    return known == nonce and 'ok' or 'exists'
  end
  terms = cjson.decode(terms)
  local fields = { ... }
  local given = {}
  for k = 1, #fields, 2 do
    given[fields[k]] = fields[k + 1]
  end
  local key = terms.key and prefix .. 'idempotency:' .. terms.key.name
  if key and taken(key) then
    return 'taken'
  end
  local source = terms.reuse and given.digest and equal(given.digest)
  if not source and too_many(owner, terms.most_jobs) then
    return 'busy'
  end
  local before = 0
  for _, upload in ipairs(terms.uploads) do
    before = before + (tonumber(read(prefix .. 'hold:' .. upload, 'bytes')) or 0)
  end
  if too_much(owner, terms.bytes - before, terms.most_bytes) then
    return 'full'
  end
  for _, upload in ipairs(terms.uploads) do
    drop_hold(upload)
  end
  redis.call('HSET', record, 'status', 'queued', 'created_at', stamp(now),
    'queued_at', stamp(now), 'owner', owner, 'nonce', nonce, 'attempt', 0, 'lost_attempts', 0,
    ...)
  charge(id, 'input_bytes', terms.bytes)
  enter(id, '')
  enter(id, ':queued')
  if given.batch then
    for _, scope in ipairs(scopes(owner)) do
      redis.call('ZADD', prefix .. 'batches' .. scope, stamp(now), given.batch)
    end
  end
  if key then
    redis.call('HSET', key, 'job', id, 'fingerprint', terms.key.fingerprint)
    redis.call('PEXPIRE', key, math.ceil(terms.key.seconds * 1000))
  end
  if source then
    take_over(source, terms.ttl)
  else
    changed(id)
  end
  return 'ok'
end

-- id is that of a job that may come to be; name of a key of idempotency, seconds until the claim
-- lapses unless it is renewed -> {'ok'} | {'busy', seconds} | {'bound', job, fingerprint}
function steps.claim(name, lease)
  local key = prefix .. 'idempotency:' .. name
  local job, fingerprint = unpack(redis.call('HMGET', key, 'job', 'fingerprint'))
  if fingerprint then
    return { 'bound', job, fingerprint }
  end
  if job and job ~= id then
    return { 'busy', stamp(redis.call('PTTL', key) / 1000) }
  end
  redis.call('HSET', key, 'job', id)
  redis.call('PEXPIRE', key, math.ceil(lease * 1000))
  return { 'ok' }
end

-- name of a key of idempotency -> 'ok'; a claim of this job is given up
function steps.unclaim(name)
  local key = prefix .. 'idempotency:' .. name
  if read(key, 'job') == id and not taken(key) then
    redis.call('DEL', key)
  end
  return 'ok'
end

-- ticket -> {the ticket that it replaces ('' for none), priority}, or nil when the job is not queued
function steps.ticket(ticket)
  if read(record, 'status') ~= 'queued' then
    return nil
  end
  local former, priority = unpack(redis.call('HMGET', record, 'ticket', 'priority'))
  redis.call('HSET', record, 'ticket', ticket)
  redis.call('HDEL', record, 'missing_since')
  return { (former and former ~= ticket) and former or '', priority or 'normal' }
end

-- worker, ticket, lease seconds -> {'ok', attempt} | {'busy' | 'finished' | 'gone'}
function steps.begin(worker, ticket, lease)
  local status = read(record, 'status')
  if not status then
    return { 'gone' }
  end
  if status == 'running' then
    if read(record, 'worker') == worker and read(record, 'held_by') == ticket then
      return { 'ok', tonumber(read(record, 'attempt')) }
    end
    return { 'busy' }
  end
  if status ~= 'queued' then
    return { 'finished' }
  end
  local attempt = redis.call('HINCRBY', record, 'attempt', 1)
  observe('wait', now - (read(record, 'queued_at') or read(record, 'created_at')))
  redis.call('HDEL', record, 'progress', 'suspected_at', 'missing_since')
  redis.call('HSET', record, 'worker', worker, 'held_by', ticket, 'started_at', stamp(now))
  redis.call('ZADD', leases, stamp(now + lease), id)
  set_status(id, 'running')
  changed(id)
  return { 'ok', attempt }
end

-- worker, lease seconds -> {state, attempt, seconds since start, seconds since cancel was asked
-- for or -1, progress}; state is 'held' | 'queued' | 'lost' | 'gone'
function steps.renew(worker, lease)
  local status = read(record, 'status')
  if not status then
    return { 'gone' }
  end
  if status ~= 'running' or read(record, 'worker') ~= worker then
    return { status == 'queued' and 'queued' or 'lost' }
  end
  renew(lease)
  local asked = read(record, 'cancel_requested_at')
  return { 'held', tonumber(read(record, 'attempt')), stamp(now - read(record, 'started_at')),
    asked and stamp(now - asked) or '-1', read(record, 'progress') or '' }
end

-- attempt, progress, lease seconds, number of frames, of points ('' where unknown) -> verdict
function steps.progress(attempt, progress, lease, frames, points)
  local answer = verdict(attempt)
  if answer == 'ok' or answer == 'cancelled' then
    renew(lease)
  end
  if answer == 'ok' then
    redis.call('HSET', record, 'progress', progress)
    if frames ~= '' then
      redis.call('HSET', record, 'frames', frames, 'points', points)
    end
    changed(id)
  end
  return answer
end

-- attempt, result prefix, its bytes, ttl, seconds by stage (JSON), then field, value, ... -> verdict
function steps.publish(attempt, result_prefix, bytes, ttl, stages, ...)
  if read(record, 'status') == 'succeeded' and read(record, 'attempt') == attempt then
    return 'ok'
  end
  local answer = verdict(attempt)
  if answer == 'ok' then
    redis.call('HSET', record, 'result_prefix', result_prefix, ...)
    charge(id, 'result_bytes', tonumber(bytes))
    for stage, seconds in pairs(cjson.decode(stages)) do
      observe('stage:' .. stage, seconds)
    end
    discard_results(id, 1, attempt - 1)
    finish(id, 'succeeded', ttl)
  end
  return answer
end

-- attempt, problem, its slug, ttl -> verdict; a job whose cancellation was asked for ends cancelled
function steps.fail(attempt, problem, slug, ttl)
  if read(record, 'status') == 'failed' and read(record, 'attempt') == attempt then
    return 'ok'
  end
  local answer = verdict(attempt)
  if answer == 'ok' then
    discard_results(id, 1, attempt)
    fail(id, problem, slug, ttl)
  end
  return answer
end

-- attempt, ttl -> verdict; 'cancelled' when the job has ended so
function steps.stop(attempt, ttl)
  if read(record, 'status') == 'cancelled' then
    return 'cancelled'
  end
  local answer = verdict(attempt)
  if answer == 'cancelled' then
    redis.call('HDEL', record, 'progress')
    discard_results(id, 1, attempt)
    finish(id, 'cancelled', ttl)
  end
  return answer
end

-- attempt or worker name, 1 if it counts as a loss, max attempts, problem when there were too many,
-- its slug, ttl -> 'queued' | 'failed' | 'cancelled' | 'lost' | 'gone'
function steps.release(holder, counts, max_attempts, problem, slug, ttl)
  local status = read(record, 'status')
  if not status then
    return 'gone'
  end
  if status ~= 'running'
    or (read(record, 'attempt') ~= holder and read(record, 'worker') ~= holder) then
    return 'lost'
  end
  return take_back(id, counts, max_attempts, problem, slug, ttl)
end

-- id is '*'; grace seconds, max attempts, problem, its slug, ttl -> {id, outcome, ...}
-- A lease that ran out is suspected at first and taken at a later look, so that workers that only
-- could not reach Redis (a restart, a suspended machine) have time to come back.
function steps.expire(grace, max_attempts, problem, slug, ttl)
  local outcome = {}
  local silent = redis.call('ZRANGEBYSCORE', leases, '-inf', stamp(now), 'LIMIT', 0, 100)
  for _, job in ipairs(silent) do
    local key = prefix .. 'job:' .. job
    local suspected = read(key, 'suspected_at')
    if read(key, 'status') ~= 'running' then
      redis.call('ZREM', leases, job)
    elseif not suspected then
      redis.call('HSET', key, 'suspected_at', stamp(now))
    elseif now - suspected >= tonumber(grace) then
      outcome[#outcome + 1] = job
      outcome[#outcome + 1] = take_back(job, 1, max_attempts, problem, slug, ttl)
    end
  end
  return outcome
end

-- id is '*'; grace seconds, then the lists of tickets -> ids that are queued without a ticket
-- A ticket that is in no list may be on its way: it is missed at a later look only.
function steps.unticketed(grace, ...)
  local present, missing = {}, {}
  for _, list in ipairs({ ... }) do
    for _, ticket in ipairs(redis.call('LRANGE', list, 0, -1)) do
      present[ticket] = true
    end
  end
  for _, job in ipairs(redis.call('ZRANGE', prefix .. 'jobs:queued', 0, -1)) do
    local key = prefix .. 'job:' .. job
    local ticket, since = unpack(redis.call('HMGET', key, 'ticket', 'missing_since'))
    if ticket and present[ticket] then
      if since then
        redis.call('HDEL', key, 'missing_since')
      end
    elseif not since then
      redis.call('HSET', key, 'missing_since', stamp(now))
    elseif now - since >= tonumber(grace) then
      missing[#missing + 1] = job
    end
  end
  return missing
end

-- ttl -> {'cancelled' | 'requested' | 'finished' | 'gone', ticket}
function steps.cancel(ttl)
  local status = read(record, 'status')
  if status == 'queued' then
    discard_results(id, 1, tonumber(read(record, 'attempt')))
    finish(id, 'cancelled', ttl)
    return { 'cancelled', read(record, 'ticket') or '' }
  end
  if status == 'running' then
    if redis.call('HSETNX', record, 'cancel_requested_at', stamp(now)) == 1 then
      changed(id)
    end
    return { 'requested' }
  end
  return { status and 'finished' or 'gone' }
end

-- most active jobs of the owner ('' for any) -> 'ok' | 'active' | 'busy' | 'gone'
function steps.retry(most_jobs)
  local status = read(record, 'status')
  if not status then
    return 'gone'
  end
  if status == 'queued' or status == 'running' then
    return 'active'
  end
  if too_many(read(record, 'owner'), tonumber(most_jobs)) then
    return 'busy'
  end
  reopen(id)
  discard_results(id, 1, tonumber(read(record, 'attempt')))
  charge(id, 'result_bytes', 0)
  redis.call('HDEL', record, 'problem', 'metrics', 'e3d', 'timings', 'result_prefix', 'reused_from',
    'progress', 'started_at', 'finished_at', 'expires_at')
  redis.call('HSET', record, 'lost_attempts', 0, 'queued_at', stamp(now))
  set_status(id, 'queued')
  changed(id)
  return 'ok'
end

-- '1' to delete only what has outlived its time, seconds until the objects are looked for again
-- -> {'ok' | 'gone' | 'kept', ticket, storage prefixes of which nothing is needed}
function steps.delete(only_expired, again)
  local status = read(record, 'status')
  if not status then
    redis.call('ZREM', expiry, id)
    return { 'gone', '' }
  end
  if only_expired == '1' then
    local due = redis.call('ZSCORE', expiry, id)
    if not due or tonumber(due) > now then
      return { 'kept', '' }
    end
  end
  local owner, batch, ticket, attempts =
    unpack(redis.call('HMGET', record, 'owner', 'batch', 'ticket', 'attempt'))
  local result = read(record, 'result_prefix')
  reopen(id)
  leave(id, '')
  leave(id, ':' .. status)
  if batch then
    for _, scope in ipairs(scopes(owner)) do
      if redis.call('EXISTS', prefix .. 'jobs' .. scope .. '#' .. batch) == 0 then
        redis.call('ZREM', prefix .. 'batches' .. scope, batch)
      end
    end
  end
  redis.call('ZREM', leases, id)
  charge(id, 'input_bytes', 0)
  charge(id, 'result_bytes', 0)
  redis.call('DEL', record)
  local unwanted, shared = {}, false
  for attempt = 1, tonumber(attempts) do
    local own = 'results/' .. id .. '/' .. attempt .. '/'
    redis.call('ZREM', garbage, own)
    if held(own) then
      shared = true
    else
      unwanted[#unwanted + 1] = own
    end
  end
  if not shared then
    unwanted = { 'results/' .. id .. '/' }
  end
  local foreign = result and not result:find('results/' .. id .. '/', 1, true)
  if foreign and not held(result) then
    unwanted[#unwanted + 1] = result
  end
  unwanted[#unwanted + 1] = 'uploads/' .. id .. '/'
  for _, folder in ipairs(unwanted) do
    redis.call('ZADD', garbage, stamp(now + again), folder)
  end
  redis.call('PUBLISH', prefix .. 'changed:' .. id, 'deleted ' .. (owner or ''))
  return { 'ok', ticket or '', unpack(unwanted) }
end

-- seconds to keep the job after its end ('' for the time that holds for all), that time
-- -> 'ok' | 'gone'
function steps.keep(own, ttl)
  if not read(record, 'status') then
    return 'gone'
  end
  if own == '' then
    redis.call('HDEL', record, 'ttl')
  else
    redis.call('HSET', record, 'ttl', own)
    ttl = own
  end
  local finished = read(record, 'finished_at')
  if finished then
    expire(id, finished, tonumber(ttl))
  end
  changed(id)
  return 'ok'
end

-- -> 'ok'; the files of the job's inputs are gone, the record stays
function steps.forget_inputs()
  if read(record, 'status') then
    charge(id, 'input_bytes', 0)
  end
  return 'ok'
end

-- id is that of an upload; owner, its bytes so far or in all, most stored bytes of the owner ('' for
-- any), seconds until it lapses -> 'ok' | 'full' (and what was held stays held)
function steps.hold(owner, bytes, most_bytes, seconds)
  local key = prefix .. 'hold:' .. id
  local more = bytes - (tonumber(read(key, 'bytes')) or 0)
  if too_much(owner, more, tonumber(most_bytes)) then
    return 'full'
  end
  add_stored(owner, more)
  redis.call('HSET', key, 'owner', owner, 'bytes', bytes)
  redis.call('ZADD', holds, stamp(now + seconds), id)
  return 'ok'
end

-- id is that of an upload that is given up -> 'ok'
function steps.drop_hold()
  drop_hold(id)
  return 'ok'
end

-- id is '*' -> number of holds that have lapsed
function steps.lapse()
  local due = redis.call('ZRANGEBYSCORE', holds, '-inf', stamp(now), 'LIMIT', 0, 100)
  for _, upload in ipairs(due) do
    drop_hold(upload)
  end
  return #due
end

return steps[step](unpack(ARGV, 3))
