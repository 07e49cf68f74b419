_mp4ds_completion() {
    local IFS=$'
'
    COMPREPLY=( $( env COMP_WORDS="${COMP_WORDS[*]}" \
                   COMP_CWORD=$COMP_CWORD \
                   _MP4DS_COMPLETE=complete_bash $1 ) )
    return 0
}

complete -o default -F _mp4ds_completion mp4ds
