"""Run graphs: sessions on the CPU, frames in order, recurrent state fed forward."""
