"""Durable jobs: the queue, the workers, and how work survives their death. Only this package imports DBOS.

What happens when a worker dies:

Who notices. Each worker holds a lock that is named after it, which the operating system or PostgreSQL releases when the worker's process or
machine ends. Every `takeover_s` seconds each worker tries the locks of the others that have jobs according to DBOS, and takes
over where a lock is free (takeover). The supervisor sees that the process ended and starts another on the device. A worker that hangs
keeps its lock: the supervisor kills it after `stall_s` seconds without a sign of life or of progress (heartbeat, supervisor).

What is recorded. The row of the job says queued again, without a worker, and counts the lost one; then DBOS queues the workflow of the same
attempt again. A job that loses more than `max_lost` workers without progress fails: without finishing a step, coming to a further stage of
it, or making a new frame.

What is done again. The next worker begins the workflow, skips the steps that the row names as finished, and does the step that was under
way again (runner). A solve reads the pieces of its passes that are done (pieces, service.sharing.sharing). A relight keeps each frame
that exists with the hash of the same request, and makes the others in small groups first. What another version of relit has done is not
kept: the job begins anew, so that its files are all those of one version. With `storage_url`, a worker on another machine finds only the
frames of finished steps, because files are sent at the end of a step.

What is not done twice. A job is changed only by the worker that its row names, in the attempt that it names (database.jobs.Claim). So a
worker that wakes after another took over its job neither ends a step nor sends files, and it ends when it finds its lock taken. Two
workers may write the same file for a moment; a file gets its name only when it is complete, and both have the same content.

What several workers do at once. The worker that has a job asks others for help, by workflows of their own in the same queue, which come
after the jobs that wait (queue). A helper does pieces of a solve or chunks of frames (steps), and changes nothing in the row of the job.
The help of a worker that dies is not queued again: the worker that has the job does what is left.
"""
