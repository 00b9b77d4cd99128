"""electrodes"""
