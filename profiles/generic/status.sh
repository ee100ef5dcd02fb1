# What became of a PBS job: running, success or failed. A job that was killed leaves no other trace; without this it would be waited for without end.
report=$(qstat -xf "$1" 2>&1)
case $? in
0) ;;
35 | 153) echo failed; exit ;;    # unknown, or forgotten: job_history_enable is needed
*) echo running; exit ;;          # no answer: ask again
esac
case $report in
*"job_state = F"*"Exit_status = 0"* | *"Exit_status = 0"*"job_state = F"*) echo success ;;
*"job_state = F"*) echo failed ;;
*) echo running ;;
esac
